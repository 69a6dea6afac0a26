// Products with a few columns, one design after another, so that the numbers of a design stay in the cache of the processor.
// See compiled_products.py.
//
// Functions work on lanes from `begin` to `end`, which share nothing: threads call them for ranges of their own.
// Arrays are row-major and [lane][row][column]. Inside, columns are padded with zeros to a multiple of eight.
// A tile keeps R rows of W x WIDTH columns of a product in registers; for wide matrices arithmetic is then the bottleneck.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <vector>

// Numbers in a register; GCC keeps vectors that are wider than a register in memory, which made products eight times slower.
#if defined(__AVX512F__)
constexpr long WIDTH = 8;
#elif defined(__AVX__)
constexpr long WIDTH = 4;
#else
constexpr long WIDTH = 2;
#endif
typedef double V __attribute__((vector_size(8 * WIDTH), aligned(8)));
typedef std::vector<double> Buffer;
typedef std::int64_t Int;  // the integers of torch; long may have 32 bits
constexpr double TINY = 2.2250738585072014e-308, STAYS = 1e-2;  // as in sparse_modes.py

struct Factor {  // of a block-tridiagonal matrix, as in blocks.py
  long blocks;
  const long* bounds;  // [blocks + 1]
  double* at;          // [lane][S_0^-1 ..., E_0 ...], S_i^-1 [s_i][s_i], E_i [s_(i+1)][s_i]
  long size() const { return bounds[blocks]; }
  long rows(long block) const { return bounds[block + 1] - bounds[block]; }
  long start(long block, bool lower) const {
    long sum = 0;
    for (long b = 0; b < (lower ? blocks : block); b++) sum += rows(b) * rows(b);
    for (long b = 0; b < (lower ? block : 0); b++) sum += rows(b) * rows(b + 1);
    return sum;
  }
  double* lane(long lane) const { return at + lane * start(blocks - 1, true); }
};

struct Left {  // the left factor of a product: entry (r, c) at at[r * row + c * column]
  const double* at;
  long row, column;
};

namespace {
inline long padded(long columns) { return (columns + 7) / 8 * 8; }

// C = A B, or C -= A B. B and C have rows of P numbers.
template <int R, int W, bool subtract>
inline void tile(long inner, Left A, const double* B, double* C, long P) {
  V sum[R][W] = {};
  for (long c = 0; c < inner; c++) {
    V b[W];
    for (int w = 0; w < W; w++) b[w] = *(const V*)(B + c * P + WIDTH * w);
    for (int r = 0; r < R; r++)
      for (int w = 0; w < W; w++) sum[r][w] += A.at[r * A.row + c * A.column] * b[w];
  }
  for (int r = 0; r < R; r++)
    for (int w = 0; w < W; w++) {
      V* to = (V*)(C + r * P + WIDTH * w);
      *to = subtract ? *to - sum[r][w] : sum[r][w];
    }
}

// The rows that tiles of R rows do not cover are computed by tiles of half as many rows.
template <int R, int W, bool subtract>
void panel(long rows, long inner, Left A, const double* B, double* C, long P) {
  long r = 0;
  for (; r + R <= rows; r += R) tile<R, W, subtract>(inner, {A.at + r * A.row, A.row, A.column}, B, C + r * P, P);
  if constexpr (R > 1)
    if (r < rows) panel<R / 2, W, subtract>(rows - r, inner, {A.at + r * A.row, A.row, A.column}, B, C + r * P, P);
}

template <bool subtract>
void product(long rows, long inner, Left A, const double* B, double* C, long P) {
  long p = 0;
  if constexpr (WIDTH == 8) {  // sums, a row of B and a number of A in 32 registers
    for (; p + 24 <= P; p += 24) panel<6, 3, subtract>(rows, inner, A, B + p, C + p, P);
    for (; p + 16 <= P; p += 16) panel<8, 2, subtract>(rows, inner, A, B + p, C + p, P);
    for (; p < P; p += 8) panel<8, 1, subtract>(rows, inner, A, B + p, C + p, P);
  } else {  // 15 of the 16 registers of AVX
    for (; p < P; p += 8) panel<6, 8 / WIDTH, subtract>(rows, inner, A, B + p, C + p, P);
  }
}

void pad_columns(const double* from, double* to, long rows, long p) {
  const long P = padded(p);
  for (long i = 0; i < rows; i++) {
    std::memcpy(to + i * P, from + i * p, p * sizeof(double));
    for (long j = p; j < P; j++) to[i * P + j] = 0.0;
  }
}

void unpad_columns(const double* from, double* to, long rows, long p) {
  const long P = padded(p);
  for (long i = 0; i < rows; i++) std::memcpy(to + i * p, from + i * P, p * sizeof(double));
}

// Subtracts from w its components along the first k columns of a basis [N][stride]: first those along the last `recent`
// columns, then those along all columns. `all` is the sum of both coefficients [k][P].
void remove_components(const double* basis, long N, long k, long stride, long recent, double* w, double* some, double* all,
                       long P) {
  std::fill(all, all + k * P, 0.0);
  for (long first : {recent < k ? k - recent : 0, 0L}) {
    product<false>(k - first, N, {basis + first, 1, stride}, w, some, P);
    product<true>(N, k - first, {basis + first, stride, 1}, some, w, P);
    for (long i = 0; i < (k - first) * P; i++) all[first * P + i] += some[i];
  }
}

// w = x r: overwrites w [N][P] by p orthonormal columns x, r [p][P] is upper triangular: Gram-Schmidt, twice.
// False: the remainder of a column is of the size of rounding, compared with the others or with `removed`, the components
// that were removed before.
bool orthonormal(double* w, long N, long p, double* r, double* second, long P, double removed) {
  bool whole = true;
  for (double* s : {r, second}) {
    std::fill(s, s + p * P, 0.0);
    for (long j = 0; j < p; j++) {
      double* row = s + j * P;
      product<false>(1, N, {w + j, 0, P}, w, row, P);
      if (!(row[j] > TINY)) {  // a zero column: any other one, made orthogonal in the second pass
        for (long i = 0; i < N; i++) w[i * P + j] = std::cos((i + 1.0) * (j + 2.0));
        std::fill(row, row + P, 0.0);
        continue;
      }
      const double size = std::sqrt(row[j]);
      for (long q = 0; q < P; q++) row[q] = q < j ? 0.0 : row[q] / size;
      for (long i = 0; i < N; i++) {
        const double x = w[i * P + j] / size;
        for (long q = 0; q < P; q += WIDTH) *(V*)&w[i * P + q] -= x * *(const V*)&row[q];
        w[i * P + j] = x;
      }
    }
    if (s != r) break;
    double least = r[0], most = r[0];
    for (long j = 0; j < p; j++) least = std::min(least, r[j * P + j]), most = std::max(most, r[j * P + j]);
    whole = least > std::max(1e-8 * most, 1e-12 * removed);  // as in `_repair` of lanczos.py
  }
  for (long i = 0; i < p; i++)  // r = second r; rows below i are still those of the first pass
    for (long j = i; j < p; j++) {
      double sum = 0.0;
      for (long k = i; k <= j; k++) sum += second[i * P + k] * r[k * P + j];
      r[i * P + j] = sum;
    }
  return whole;
}

// x = A^-1 y; overwrites y.
void solve_lane(const Factor& f, long lane, double* y, double* x, long P) {
  const double* E = f.lane(lane) + f.start(0, true);
  for (long b = 1; b < f.blocks; b++) {
    const long s = f.rows(b), before = f.rows(b - 1);
    product<true>(s, before, {E, before, 1}, y + f.bounds[b - 1] * P, y + f.bounds[b] * P, P);
    E += s * before;
  }
  const double* S = f.lane(lane) + f.start(0, true);
  for (long b = f.blocks - 1; b >= 0; b--) {
    const long s = f.rows(b);
    double* here = x + f.bounds[b] * P;
    S -= s * s;
    product<false>(s, s, {S, s, 1}, y + f.bounds[b] * P, here, P);
    if (b + 1 == f.blocks) continue;
    const long after = f.rows(b + 1);
    E -= after * s;
    product<true>(s, after, {E, 1, s}, x + f.bounds[b + 1] * P, here, P);
  }
}

// The inverse of a positive definite a [s][P] in its place, by elimination; `pivot` [s] are its pivots. False: it is not.
bool invert(double* a, long s, long P, double* pivot) {
  for (long k = 0; k < s; k++) {
    double* row = a + k * P;
    if (!((pivot[k] = row[k]) > 0.0)) return false;
    const double inverse = 1.0 / row[k];
    row[k] = 1.0;
    for (long j = 0; j < P; j += WIDTH) *(V*)(row + j) *= inverse;
    for (long i = 0; i < s; i++) {
      if (i == k) continue;
      double* other = a + i * P;
      const double share = other[k];
      other[k] = 0.0;
      for (long j = 0; j < P; j += WIDTH) *(V*)(other + j) -= share * *(V*)(row + j);
    }
  }
  return true;
}

// Columns of a lane in conjugate gradients; converged columns are removed.
struct Columns {
  long N, P;
  std::vector<long> number;               // index in the result of each column; -1: padding
  Buffer y, r, d, Hd, work;                 // [N][P]
  Buffer square, target, inverse_mu, step;  // [P]

  void dots(const Buffer& a, const Buffer& b, Buffer& out) const {
    for (long p = 0; p < P; p += WIDTH) {
      V sum = {};
      for (long i = 0; i < N; i++) sum += *(const V*)&a[i * P + p] * *(const V*)&b[i * P + p];
      std::memcpy(&out[p], &sum, sizeof(V));
    }
  }
  void put(double* to, long p) const {
    for (long j = 0; j < P; j++)
      if (number[j] >= 0)
        for (long i = 0; i < N; i++) to[i * p + number[j]] = y[i * P + j];
  }
  void keep(const std::vector<long>& open) {
    const long few = padded((long)open.size());
    for (Buffer* x : {&y, &r, &d})
      for (long i = 0; i < N; i++)  // rows only move forward
        for (long j = 0; j < few; j++) (*x)[i * few + j] = j < (long)open.size() ? (*x)[i * P + open[j]] : 0.0;
    std::vector<long> kept(few, -1);
    for (long j = 0; j < few; j++) {
      const bool some = j < (long)open.size();
      kept[j] = some ? number[open[j]] : -1;
      square[j] = some ? square[open[j]] : 0.0;
      target[j] = some ? target[open[j]] : 0.0;
      inverse_mu[j] = some ? inverse_mu[open[j]] : 0.0;
    }
    number = kept;
    P = few;
  }
};
}  // namespace

// Overwrites D_i and B_i by S_i^-1 and E_i: BlockFactor of blocks.py. pivot [lane]: the smallest, relative to the diagonal.
extern "C" void factorize(long begin, long end, const Factor* f, double* pivot) {
  long most = 0;
  for (long b = 0; b < f->blocks; b++) most = std::max(most, f->rows(b));
  Buffer S(most * padded(most)), B(most * padded(most)), E(most * padded(most)), diagonal(most), found(most);
  for (long lane = begin; lane < end; lane++) {
    double *D = f->lane(lane), *lower = D + f->start(0, true);
    pivot[lane] = HUGE_VAL;
    for (long b = 0; b < f->blocks; b++) {
      const long s = f->rows(b), P = padded(s);
      pad_columns(D, S.data(), s, s);
      for (long i = 0; i < s; i++) diagonal[i] = D[i * s + i];
      if (b) {  // S -= E B'
        const long before = f->rows(b - 1);
        product<true>(s, before, {E.data(), padded(before), 1}, B.data(), S.data(), P);
      }
      if (invert(S.data(), s, P, found.data())) {
        for (long i = 0; i < s; i++) pivot[lane] = std::min(pivot[lane], found[i] / diagonal[i]);
      } else {  // an identity, so that the other lanes go on
        pivot[lane] = -1.0;
        std::fill(S.begin(), S.end(), 0.0);
        for (long i = 0; i < s; i++) S[i * P + i] = 1.0;
      }
      unpad_columns(S.data(), D, s, s);
      D += s * s;
      if (b + 1 == f->blocks) continue;
      const long next = f->rows(b + 1), Q = padded(next);
      product<false>(next, s, {lower, s, 1}, S.data(), E.data(), P);
      for (long i = 0; i < s; i++)
        for (long j = 0; j < Q; j++) B[i * Q + j] = j < next ? lower[j * s + i] : 0.0;  // B'
      unpad_columns(E.data(), lower, next, s);
      lower += next * s;
    }
  }
}

// out [lane][N][p] = A^-1 X.
extern "C" void solve(long begin, long end, const Factor* f, const double* X, double* out, long p) {
  const long N = f->size(), P = padded(p);
  Buffer y(N * P), x(N * P);
  for (long lane = begin; lane < end; lane++) {
    pad_columns(X + lane * N * p, y.data(), N, p);
    solve_lane(*f, lane, y.data(), x.data(), P);
    unpad_columns(x.data(), out + lane * N * p, N, p);
  }
}

// A strip of S columns of L x = y, then L' z = x, in place. The rows of x that a supernode has are gathered to be neighbors: its
// columns, then the rows below its triangle. C of its columns change a row while it is in registers.
namespace {
constexpr long STRIP = 16, FEW = 8;  // columns of a strip, and of one that is not filled

struct Supernode {
  long column, width, rows;  // its first column; rows below its triangle
  const Int *below, *start;
  const double* values;
  const double* at(long c) const { return values + start[column + c] - c; }  // entry i of column c is at(c)[i]
};

template <int S>
struct Strip {
  static constexpr int PARTS = S / WIDTH;
  static constexpr int C = WIDTH == 8 ? 6 : S == 8 ? 3 : 2;  // sums, numbers of C columns and a row in the registers

  static V& part(double* x, long row, int w) { return *(V*)(x + row * S + WIDTH * w); }
  static void subtract(double factor, double* x, long from, long to) {
    for (int w = 0; w < PARTS; w++) part(x, to, w) -= factor * part(x, from, w);
  }
  static void divide(double* x, long row, double by) {
    for (int w = 0; w < PARTS; w++) part(x, row, w) *= 1.0 / by;
  }

  // Columns c to c + K of L x = y, for all rows of the supernode.
  template <int K>
  static void forward(const Supernode& s, long c, double* x) {
    const double* column[K];
    for (int k = 0; k < K; k++) {
      column[k] = s.at(c + k);
      divide(x, c + k, column[k][c + k]);
      for (int j = k + 1; j < K; j++) subtract(column[k][c + j], x, c + k, c + j);
    }
    V here[K][PARTS];
    for (int k = 0; k < K; k++)
      for (int w = 0; w < PARTS; w++) here[k][w] = part(x, c + k, w);
    const double* next = column[K - 1] + s.width + s.rows;  // the values of the next columns, which come from memory
    for (long i = c + K; i < s.width + s.rows; i++) {
      if (K == C) __builtin_prefetch(next + (i - c - K) * K);
      for (int w = 0; w < PARTS; w++) {
        V sum = part(x, i, w);
        for (int k = 0; k < K; k++) sum -= column[k][i] * here[k][w];
        part(x, i, w) = sum;
      }
    }
  }

  // Columns c to c + K of L' z = x.
  template <int K>
  static void backward(const Supernode& s, long c, double* x) {
    const double* column[K];
    V sum[K][PARTS] = {};
    for (int k = 0; k < K; k++) column[k] = s.at(c + k);
    const double* next = column[0] + c;
    for (long i = c + K; i < s.width + s.rows; i++) {
      if (K == C) __builtin_prefetch(next - (i - c - K + 1) * K);
      for (int w = 0; w < PARTS; w++) {
        const V from = part(x, i, w);
        for (int k = 0; k < K; k++) sum[k][w] += column[k][i] * from;
      }
    }
    for (int k = K - 1; k >= 0; k--) {
      for (int w = 0; w < PARTS; w++) part(x, c + k, w) -= sum[k][w];
      for (int j = k + 1; j < K; j++) subtract(column[k][c + j], x, c + j, c + k);
      divide(x, c + k, column[k][c + k]);
    }
  }

  static void gather(const Supernode& s, const double* x, double* local) {
    std::memcpy(local, x + s.column * S, s.width * S * sizeof(double));
    for (long i = 0; i < s.rows; i++) std::memcpy(local + (s.width + i) * S, x + s.below[i] * S, S * sizeof(double));
  }

  static void solve(const std::vector<Supernode>& nodes, double* x, double* local) {
    for (auto s = nodes.begin(); s != nodes.end(); s++) {
      gather(*s, x, local);
      long c = 0;
      for (; c + C <= s->width; c += C) forward<C>(*s, c, local);
      for (; c < s->width; c++) forward<1>(*s, c, local);
      std::memcpy(x + s->column * S, local, s->width * S * sizeof(double));
      for (long i = 0; i < s->rows; i++) std::memcpy(x + s->below[i] * S, local + (s->width + i) * S, S * sizeof(double));
    }
    for (auto s = nodes.rbegin(); s != nodes.rend(); s++) {
      gather(*s, x, local);
      long c = s->width;
      for (; c % C; c--) backward<1>(*s, c - 1, local);
      for (; c > 0; c -= C) backward<C>(*s, c - C, local);
      std::memcpy(x + s->column * S, local, s->width * S * sizeof(double));
    }
  }
};

// P' L'^-1 L^-1 P X for the columns of X [N][p] from one on.
template <int S>
void solve_strip(const std::vector<Supernode>& nodes, long N, const Int* order, const double* X, double* out, long p, long from,
                 Buffer& x, Buffer& local) {
  const long columns = std::min<long>(p - from, S);
  for (long i = 0; i < N; i++)
    for (long k = 0; k < S; k++) x[i * S + k] = k < columns ? X[order[i] * p + from + k] : 0.0;
  Strip<S>::solve(nodes, x.data(), local.data());
  for (long i = 0; i < N; i++) std::memcpy(out + order[i] * p + from, &x[i * S], columns * sizeof(double));
}
}  // namespace

// P' L'^-1 L^-1 P X [N][p] by strips of columns; the arrays of `Supernodes` (math/products.py).
extern "C" void solve_supernodes(long begin, long end, long N, long supernodes, const Int* first, const Int* below_start,
                                 const Int* below, const Int* start, const Int* order, const double* values, const double* X,
                                 double* out, long p) {
  const long widest = p > FEW ? STRIP : FEW;
  std::vector<Supernode> nodes;
  long most = 0;
  for (long s = 0; s < supernodes; s++) {
    const long rows = below_start[s + 1] - below_start[s], width = first[s + 1] - first[s];
    nodes.push_back({first[s], width, rows, below + below_start[s], start, values});
    most = std::max(most, width + rows);
  }
  Buffer x(N * widest), local(most * widest);
  for (long strip = begin; strip < end; strip++) {
    const long from = strip * STRIP;
    (p - from > FEW ? solve_strip<STRIP> : solve_strip<FEW>)(nodes, N, order, X, out, p, from, x, local);
  }
}

// Steps `from` to `to` of block Lanczos for H = G A^-1 G, as `_extend` of lanczos.py: the next block X [lane][N][p] becomes
// columns of Q [lane][N][room], the components of H X along Q become columns of T [lane][room][room]; X R, with R
// [lane][p][p], is the remainder of H X.
extern "C" void lanczos(long begin, long end, const Factor* f, const double* G, long from, long to, long room, long p, double* Q, double* T,
                        double* X, double* R) {
  const long N = f->size(), P = padded(p), most = to * p;
  Buffer x(N * P), y(N * P), w(N * P), some(most * P), all(most * P), r(p * P), second(p * P);
  for (long lane = begin; lane < end; lane++) {
    const double* g = G + lane * N;
    double *basis = Q + lane * N * room, *t = T + lane * room * room;
    pad_columns(X + lane * N * p, x.data(), N, p);
    for (long k = from * p; k < to * p; k += p) {
      for (long i = 0; i < N; i++) {
        std::memcpy(basis + i * room + k, &x[i * P], p * sizeof(double));
        for (long j = 0; j < P; j++) y[i * P + j] = g[i] * x[i * P + j];
      }
      solve_lane(*f, lane, y.data(), w.data(), P);
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j++) w[i * P + j] *= g[i];
      remove_components(basis, N, k + p, room, 2 * p, w.data(), some.data(), all.data(), P);
      for (long i = 0; i < k + p; i++) std::memcpy(t + i * room + k, &all[i * P], p * sizeof(double));
      double largest = 0.0;
      for (long i = 0; i < (k + p) * P; i++) largest = std::max(largest, std::abs(all[i]));
      x = w;
      if (!orthonormal(x.data(), N, p, r.data(), second.data(), P, largest))  // the remainder is rounding
        for (int again = 0; again < 2; again++) {
          remove_components(basis, N, k + p, room, p, x.data(), some.data(), all.data(), P);
          orthonormal(x.data(), N, p, some.data(), second.data(), P, 0.0);
        }
    }
    unpad_columns(x.data(), X + lane * N * p, N, p);
    unpad_columns(r.data(), R + lane * p * p, p, p);
  }
}

// out [lane][t][nnz] = Y X' at the entries of a pattern, for Y [lane][T][N][p] and X [lane][N][p].
extern "C" void products_at_pattern(long begin, long end, long T, long N, const int* start, const int* column, const double* Y,
                                    const double* X, double* out, long p) {
  const long P = padded(p), nnz = start[N];
  Buffer x(N * P), y(N * P);
  for (long lane = begin; lane < end; lane++) {
    pad_columns(X + lane * N * p, x.data(), N, p);
    for (long t = lane * T; t < (lane + 1) * T; t++) {
      pad_columns(Y + t * N * p, y.data(), N, p);
      for (long i = 0; i < N; i++)
        for (int e = start[i]; e < start[i + 1]; e++) {
          V sum = {};
          for (long j = 0; j < P; j += WIDTH) sum += *(const V*)&y[i * P + j] * *(const V*)&x[column[e] * P + j];
          double total = 0.0;
          for (long j = 0; j < WIDTH; j++) total += sum[j];
          out[t * nnz + e] = total;
        }
    }
  }
}

// out [lane][T][N][p] = K X for values [lane][T][nnz] on one pattern and X [lane][N][p].
extern "C" void multiply_sparse(long begin, long end, long T, long N, const int* start, const int* column, const double* values,
                                const double* X, double* out, long p) {
  const long P = padded(p), nnz = start[N];
  Buffer x(N * P), z(N * P);
  for (long lane = begin; lane < end; lane++) {
    pad_columns(X + lane * N * p, x.data(), N, p);
    for (long t = lane * T; t < (lane + 1) * T; t++) {
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j += WIDTH) {
          V sum = {};
          for (int e = start[i]; e < start[i + 1]; e++) sum += values[t * nnz + e] * *(const V*)&x[column[e] * P + j];
          std::memcpy(&z[i * P + j], &sum, sizeof(V));
        }
      unpad_columns(z.data(), out + t * N * p, N, p);
    }
  }
}

// Conjugate gradients for (1 - H / mu) y = c among vectors orthogonal to U, H = G A^-1 G: `_conjugate_gradients` of
// sparse_modes.py. y [lane][N][p] in and out, r its residual, U [lane][N][n], G [lane][N], target and inverse_mu [lane][p].
// Returns 1 if a lane needs more than `most` steps.
extern "C" long conjugate_gradients(long begin, long end, const Factor* f, const double* G, const double* U, long n, const double* inverse_mu,
                                    const double* target, double* y, const double* r, long p, long most) {
  const long N = f->size(), full = padded(p);
  Buffer inside(n * full);
  for (long lane = begin; lane < end; lane++) {
    Columns c{N, full};
    for (Buffer* x : {&c.y, &c.r, &c.Hd, &c.work}) x->resize(N * full);
    for (Buffer* x : {&c.square, &c.target, &c.inverse_mu, &c.step}) x->resize(full);
    for (long j = 0; j < full; j++) c.number.push_back(j < p ? j : -1);
    std::memcpy(c.target.data(), target + lane * p, p * sizeof(double));
    std::memcpy(c.inverse_mu.data(), inverse_mu + lane * p, p * sizeof(double));
    pad_columns(y + lane * N * p, c.y.data(), N, p);
    pad_columns(r + lane * N * p, c.r.data(), N, p);
    c.d = c.r;
    c.dots(c.r, c.r, c.square);
    const double *g = G + lane * N, *u = U + lane * N * n;
    for (long k = 0;; k++) {
      std::vector<long> open;
      for (long j = 0; j < c.P; j++)
        if (std::sqrt(c.square[j]) > c.target[j]) open.push_back(j);
      if (padded((long)open.size()) < c.P) {
        c.put(y + lane * N * p, p);
        c.keep(open);
      }
      if (open.empty()) break;
      if (k == most) return 1;
      const long P = c.P;
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j++) c.work[i * P + j] = g[i] * c.d[i * P + j];
      solve_lane(*f, lane, c.work.data(), c.Hd.data(), P);
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j++) c.Hd[i * P + j] = c.d[i * P + j] - c.inverse_mu[j] * (g[i] * c.Hd[i * P + j]);
      product<false>(n, N, {u, 1, n}, c.Hd.data(), inside.data(), P);
      product<true>(N, n, {u, n, 1}, inside.data(), c.Hd.data(), P);
      c.dots(c.d, c.Hd, c.step);
      for (long j = 0; j < P; j++)
        c.step[j] = std::sqrt(c.square[j]) > STAYS * c.target[j] ? c.square[j] / (c.step[j] > TINY ? c.step[j] : TINY) : 0.0;
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j++) {
          c.y[i * P + j] += c.step[j] * c.d[i * P + j];
          c.r[i * P + j] -= c.step[j] * c.Hd[i * P + j];
        }
      Buffer before = c.square;
      c.dots(c.r, c.r, c.square);
      for (long j = 0; j < P; j++) before[j] = c.square[j] / (before[j] > TINY ? before[j] : TINY);
      for (long i = 0; i < N; i++)
        for (long j = 0; j < P; j++) c.d[i * P + j] = before[j] * c.d[i * P + j] + c.r[i * P + j];
    }
  }
  return 0;
}

// Supernodes of P A P' = L L': groups of columns with the same rows below their triangle. `order` becomes a postorder of the
// elimination tree; returns how many supernodes there are. Small ones are merged with their parent where that adds few zeros,
// by the shares of CHOLMOD. first [supernodes + 1], below_start [supernodes + 1], as in products.py; both have room for N + 1.
extern "C" long supernode_bounds(long N, const int* indptr, const int* indices, Int* order, Int* first, Int* below_start) {
  const int none = -1;
  std::vector<int> inverse(N), parent(N, none), ancestor(N, none), child(N, none), sibling(N, none), place(N), stack;
  for (long k = 0; k < N; k++) inverse[order[k]] = (int)k;
  for (int k = 0; k < N; k++)
    for (int e = indptr[order[k]]; e < indptr[order[k] + 1]; e++)
      for (int j = inverse[indices[e]], next; j != none && j < k; j = next) {
        next = ancestor[j];
        ancestor[j] = k;
        if (next == none) parent[j] = k;
      }
  for (int k = (int)N - 1; k >= 0; k--)
    if (parent[k] != none) sibling[k] = child[parent[k]], child[parent[k]] = k;
  std::vector<long> before(order, order + N);
  int placed = 0;
  for (int k = 0; k < N; k++) {
    if (parent[k] != none) continue;
    stack.push_back(k);
    while (!stack.empty()) {
      const int top = stack.back(), next = child[top];
      if (next != none) {
        child[top] = sibling[next];
        stack.push_back(next);
      } else {
        stack.pop_back();
        order[placed] = before[top];
        place[top] = placed++;
      }
    }
  }
  std::vector<int> above(N, none), mark(N, none), count(N, 1);
  for (long k = 0; k < N; k++) inverse[order[k]] = (int)k;
  for (long k = 0; k < N; k++)
    if (parent[k] != none) above[place[k]] = place[parent[k]];
  for (int k = 0; k < N; k++) {
    mark[k] = k;
    for (int e = indptr[order[k]]; e < indptr[order[k] + 1]; e++)
      for (int j = inverse[indices[e]]; j < k && mark[j] != k; j = above[j]) count[j]++, mark[j] = k;
  }
  struct Node {
    long first, width, below, zeros;
  };
  const auto entries = [](long width, long below) { return width * (width + 1) / 2 + width * below; };
  const auto cheap = [](long width, double zeros) { return width <= 4 || zeros < (width <= 16 ? 0.8 : width <= 48 ? 0.1 : 0.05); };
  std::vector<Node> nodes;
  for (long k = 0; k < N;) {
    long end = k + 1;
    while (end < N && above[end - 1] == end && count[end - 1] == count[end] + 1) end++;
    nodes.push_back({k, end - k, count[k] - (end - k), 0});
    k = end;
    while (nodes.size() > 1) {
      const Node last = nodes.back(), inner = nodes[nodes.size() - 2];
      const int up = above[last.first - 1];
      if (up < last.first || up >= last.first + last.width) break;
      const long width = inner.width + last.width, zeros = inner.zeros + last.zeros + inner.width * (last.width + last.below - inner.below);
      if (!cheap(width, (double)zeros / entries(width, last.below))) break;
      nodes.resize(nodes.size() - 2);
      nodes.push_back({inner.first, width, last.below, zeros});
    }
  }
  below_start[0] = 0;
  for (size_t s = 0; s < nodes.size(); s++) {
    first[s] = nodes[s].first;
    below_start[s + 1] = below_start[s] + nodes[s].below;
  }
  first[nodes.size()] = N;
  return (long)nodes.size();
}

namespace {
// The supernodes that have s as their parent, the one with the first of the rows below.
struct Children {
  std::vector<int> head, next;
  Children(long supernodes) : head(supernodes, -1), next(supernodes, -1) {}
  void add(long parent, long s) { next[s] = head[parent], head[parent] = (int)s; }
};

std::vector<int> inverse_of(const Int* order, long N) {
  std::vector<int> inverse(N);
  for (long k = 0; k < N; k++) inverse[order[k]] = (int)k;
  return inverse;
}

std::vector<int> node_of_column(const Int* first, long supernodes, long N) {
  std::vector<int> node(N);
  for (long s = 0; s < supernodes; s++)
    for (long k = first[s]; k < first[s + 1]; k++) node[k] = (int)s;
  return node;
}
}  // namespace

// The rows below the triangle of each supernode, in rising order.
extern "C" void supernode_rows(long N, const int* indptr, const int* indices, const Int* order, long supernodes, const Int* first,
                               const Int* below_start, Int* below) {
  const std::vector<int> inverse = inverse_of(order, N), node = node_of_column(first, supernodes, N);
  std::vector<long> mark(N, -1);
  Children children(supernodes);
  for (long s = 0; s < supernodes; s++) {
    const long end = first[s + 1];
    Int* to = below + below_start[s];
    const auto add = [&](long row) {
      if (row >= end && mark[row] != s) mark[row] = s, *to++ = row;
    };
    for (long k = first[s]; k < end; k++)
      for (int e = indptr[order[k]]; e < indptr[order[k] + 1]; e++) add(inverse[indices[e]]);
    for (int c = children.head[s]; c >= 0; c = children.next[c])
      for (long e = below_start[c]; e < below_start[c + 1]; e++) add(below[e]);
    std::sort(below + below_start[s], to);
    if (below_start[s + 1] > below_start[s]) children.add(node[below[below_start[s]]], s);
  }
}

namespace {
constexpr long PANEL = 64, NARROW_PANEL = 8;

// The lower triangle of a front of r rows: columns of P numbers.
struct Front {
  double* at;
  long r, P;

  void clear() const {  // with what `subtract` computes above the diagonal and is not used
    for (long c = 0; c < r; c++) std::fill(at + c * P + std::max(c - 24, 0L), at + (c + 1) * P, 0.0);
  }

  // Subtracts from columns j0 ... j1 their products with columns c0 ... c1, from row j0 on.
  void subtract(long c0, long c1, long j0, long j1) const {
    constexpr long widest = WIDTH == 8 ? 24 : 8;
    for (long i = j0; i < r;) {
      const long strip = std::min(widest, padded(r - i)), count = std::min(j1, i + strip) - j0;
      const Left left{at + c0 * P + j0, 1, P};
      const double* B = at + c0 * P + i;
      double* C = at + j0 * P + i;
      if constexpr (WIDTH == 8) {
        if (strip == 24) panel<6, 3, true>(count, c1 - c0, left, B, C, P);
        if (strip == 16) panel<8, 2, true>(count, c1 - c0, left, B, C, P);
        if (strip == 8) panel<8, 1, true>(count, c1 - c0, left, B, C, P);
      } else {
        panel<6, 8 / WIDTH, true>(count, c1 - c0, left, B, C, P);
      }
      i += strip;
    }
  }

  // Factorizes columns c0 ... c1; returns the column whose pivot is not positive, or -1. `pivots`: the squares of the diagonal.
  long columns(long c0, long c1, double* pivots) const {
    for (long c = c0; c < c1; c++) {
      double* column = at + c * P;
      if (!(column[c] > 0.0)) return c;
      pivots[c] = column[c];
      const double scale = 1.0 / std::sqrt(column[c]);
      for (long i = c; i < r; i++) column[i] *= scale;
      for (long k = c + 1; k < c1; k++) {
        double* other = at + k * P;
        const double factor = column[k];
        for (long i = k; i < r; i++) other[i] -= factor * column[i];
      }
    }
    return -1;
  }

  // Factorizes the first `width` columns, and leaves in the others what is to be added to the parent.
  long factorize(long width, double* pivots) const {
    for (long a = 0; a < width; a += PANEL) {
      const long end = std::min(a + PANEL, width);
      for (long c = a; c < end; c += NARROW_PANEL) {
        const long next = std::min(c + NARROW_PANEL, end), weak = columns(c, next, pivots);
        if (weak >= 0) return weak;
        if (next < end) subtract(c, next, next, end);
      }
      if (end < r) subtract(a, end, end, r);
    }
    return -1;
  }
};
}  // namespace

namespace {
struct Run {  // rows of a front that are neighbors, also in a child
  int begin, end;
};

// The most numbers that wait for their parents at a time.
long most_waiting(const std::vector<int>& node, long supernodes, const Int* below_start, const Int* below) {
  Children children(supernodes);
  std::vector<long> from(supernodes);
  long waits = 0, most = 0;
  for (long s = 0; s < supernodes; s++) {
    const long beneath = below_start[s + 1] - below_start[s];
    for (int c = children.head[s]; c >= 0; c = children.next[c]) waits = std::min(waits, from[c]);
    if (!beneath) continue;
    from[s] = waits;
    waits += beneath * (beneath + 1) / 2;
    most = std::max(most, waits);
    children.add(node[below[below_start[s]]], s);
  }
  return most;
}
}  // namespace

// Values of L [lane][entries] for A [lane][nnz], whose pattern has both triangles: multifrontal, children before their parents.
// pivot [lane]: the smallest relative to its diagonal entry, -1 where one is not positive.
extern "C" void factorize_supernodes(long begin, long end, long N, long supernodes, const int* indptr, const int* indices,
                                     const Int* first, const Int* below_start, const Int* below, const Int* start,
                                     const Int* order, const double* A, double* L, double* pivot) {
  const std::vector<int> inverse = inverse_of(order, N), node = node_of_column(first, supernodes, N);
  std::vector<int> place(N);
  std::vector<Run> runs;
  long largest = 0;
  for (long s = 0; s < supernodes; s++) {
    const long r = first[s + 1] - first[s] + below_start[s + 1] - below_start[s];
    largest = std::max(largest, r * (padded(r) + 8));
  }
  const std::unique_ptr<double[]> waiting(new double[most_waiting(node, supernodes, below_start, below)]);
  Buffer numbers(largest), pivots, diagonal;
  std::vector<long> waiting_from(supernodes);
  for (long lane = begin; lane < end; lane++) {
    const double* values = A + lane * indptr[N];
    double* to = L + lane * start[N];
    Children children(supernodes);
    long waits = 0;
    pivot[lane] = INFINITY;
    for (long s = 0; s < supernodes && pivot[lane] >= 0.0; s++) {
      const long width = first[s + 1] - first[s], beneath = below_start[s + 1] - below_start[s], r = width + beneath;
      const Front front{numbers.data(), r, padded(r) + 8};
      const Int* rows = below + below_start[s];
      front.clear();
      for (long t = 0; t < width; t++) place[first[s] + t] = (int)t;
      for (long t = 0; t < beneath; t++) place[rows[t]] = (int)(width + t);
      pivots.assign(width, 0.0), diagonal.assign(width, 0.0);
      for (long t = 0; t < width; t++) {
        const long row = order[first[s] + t];
        for (int e = indptr[row]; e < indptr[row + 1]; e++) {
          const int k = inverse[indices[e]];
          if (k >= first[s] + t) front.at[t * front.P + place[k]] = values[e];
        }
        diagonal[t] = front.at[t * front.P + t];
      }
      for (int c = children.head[s]; c >= 0; c = children.next[c]) {
        const double* sum = waiting.get() + waiting_from[c];
        waits = std::min(waits, waiting_from[c]);
        runs.clear();
        for (long e = below_start[c]; e < below_start[c + 1]; e++)
          if (runs.size() && place[below[e]] == runs.back().end) runs.back().end++;
          else runs.push_back({place[below[e]], place[below[e]] + 1});
        for (size_t first_run = 0; first_run < runs.size(); first_run++)
          for (int j = runs[first_run].begin; j < runs[first_run].end; j++) {
            double* column = front.at + j * front.P;
            for (int i = j; i < runs[first_run].end; i++) column[i] += *sum++;
            for (size_t run = first_run + 1; run < runs.size(); run++)
              for (int i = runs[run].begin; i < runs[run].end; i++) column[i] += *sum++;
          }
      }
      const long weak = front.factorize(width, pivots.data());
      for (long t = 0; t < (weak < 0 ? width : weak); t++) pivot[lane] = std::min(pivot[lane], pivots[t] / std::abs(diagonal[t]));
      if (weak >= 0) pivot[lane] = -1.0;
      for (long t = 0; t < width; t++) std::memcpy(to + start[first[s] + t], front.at + t * front.P + t, (r - t) * sizeof(double));
      if (!beneath) continue;
      waiting_from[s] = waits;
      double* sum = waiting.get() + waits;
      waits += beneath * (beneath + 1) / 2;
      for (long t = width; t < r; t++, sum += r + 1 - t) std::memcpy(sum, front.at + t * front.P + t, (r - t) * sizeof(double));
      children.add(node[rows[0]], s);
    }
  }
}

// Rows [i <= j][a][A] of d_i d_j' of one point, d [r][s][A] with A = padded(a); with e: d_i e_j' + e_i d_j'.
static void outer(const double* d, const double* e, long r, long s, long a, long A, double* rows) {
  for (long i = 0; i < r; i++)
    for (long j = i; j < r; j++, rows += a * A)
      for (long p = 0; p < a; p++)
        for (long q = 0; q < A; q += WIDTH) {
          V sum = {};
          for (long t = 0; t < s; t++) {
            const long x = (i * s + t) * A, y = (j * s + t) * A;
            sum += d[x + p] * *(const V*)(e + y + q);
            if (e != d) sum += e[x + p] * *(const V*)(d + y + q);
          }
          std::memcpy(rows + p * A + q, &sum, sizeof(V));
        }
}

constexpr long POINTS = 32;  // points whose products fit into the cache

// out [lane][k][a][a] = sum over points and i <= j of law [lane][k][point][ij] times the rows of `outer`; d, e [lane][point][r][s][a].
extern "C" void quadratic_forms(long begin, long end, long k, long points, long r, long s, long a, const double* law, const double* d,
                                const double* e, double* out) {
  const long A = padded(a), ij = r * (r + 1) / 2, one = r * s * a;
  Buffer left(r * s * A), right(r * s * A), rows(POINTS * ij * a * A), sum(k * a * A);
  for (long lane = begin; lane < end; lane++) {
    const double *laws = law + lane * k * points * ij, *ds = d + lane * points * one, *es = e + lane * points * one;
    double* to = out + lane * k * a * a;
    std::fill(sum.begin(), sum.end(), 0.0);
    for (long first = 0; first < points; first += POINTS) {
      const long count = std::min(POINTS, points - first);
      for (long p = 0; p < count; p++) {
        pad_columns(ds + (first + p) * one, left.data(), r * s, a);
        if (e != d) pad_columns(es + (first + p) * one, right.data(), r * s, a);
        outer(left.data(), e == d ? left.data() : right.data(), r, s, a, A, &rows[p * ij * a * A]);
      }
      product<true>(k, count * ij, {laws + first * ij, points * ij, 1}, rows.data(), sum.data(), a * A);
    }
    for (long i = 0; i < k * a; i++)
      for (long j = 0; j < a; j++) *to++ = -sum[i * A + j];
  }
}

// The derivatives of sum G . quadratic_forms, G [lane][k][a][a] symmetric, by law and by d where e is d.
extern "C" void quadratic_slopes(long begin, long end, long k, long points, long r, long s, long a, const double* law, const double* d,
                                 const double* G, double* by_law, double* by_d) {
  const long A = padded(a), K = padded(k), ij = r * (r + 1) / 2, one = r * s * a;
  Buffer own(r * s * A), turned(r * s * A), rows(POINTS * ij * a * A), H(POINTS * ij * a * A), pairs(POINTS * ij * K);
  Buffer weights(k * a * A), across(a * A * K);
  for (long lane = begin; lane < end; lane++) {
    const double *laws = law + lane * k * points * ij, *from = d + lane * points * one;
    double *by_laws = by_law + lane * k * points * ij, *to = by_d + lane * points * one;
    pad_columns(G + lane * k * a * a, weights.data(), k * a, a);
    std::fill(across.begin(), across.end(), 0.0);
    for (long n = 0; n < k; n++)
      for (long i = 0; i < a * A; i++) across[i * K + n] = weights[n * a * A + i];
    for (long first = 0; first < points; first += POINTS) {
      const long count = std::min(POINTS, points - first);
      product<false>(count * ij, k, {laws + first * ij, 1, points * ij}, weights.data(), H.data(), a * A);
      for (long p = 0; p < count; p++, from += one, to += one) {
        pad_columns(from, own.data(), r * s, a);
        outer(own.data(), own.data(), r, s, a, A, &rows[p * ij * a * A]);
        std::fill(turned.begin(), turned.end(), 0.0);
        const double* h = &H[p * ij * a * A];
        for (long i = 0; i < r; i++)
          for (long j = i; j < r; j++, h += a * A)
            for (long t = 0; t < s; t++)
              for (long b = 0; b < a; b++)
                for (long q = 0; q < A; q += WIDTH) {
                  const V along = *(const V*)(h + b * A + q);
                  *(V*)&turned[(i * s + t) * A + q] += own[(j * s + t) * A + b] * along;
                  *(V*)&turned[(j * s + t) * A + q] += own[(i * s + t) * A + b] * along;
                }
        unpad_columns(turned.data(), to, r * s, a);
      }
      product<false>(count * ij, a * A, {rows.data(), a * A, 1}, across.data(), pairs.data(), K);
      for (long n = 0; n < k; n++)
        for (long i = 0; i < count * ij; i++) by_laws[n * points * ij + first * ij + i] = pairs[i * K + n];
    }
  }
}

// y [lane][rows]: of every row the sum of x [lane][size] over its terms, those from start[row] on.
extern "C" void sums(long begin, long end, long rows, long size, const int* start, const int* term, const double* x, double* y) {
  for (long lane = begin; lane < end; lane++)
    for (long k = 0; k < rows; k++) {
      double sum = 0.0;
      for (int e = start[k]; e < start[k + 1]; e++) sum += x[lane * size + term[e]];
      y[lane * rows + k] = sum;
    }
}

// The transpose, added to x [lane][size].
extern "C" void transposed_sums(long begin, long end, long rows, long size, const int* start, const int* term, const double* y,
                                double* x) {
  for (long lane = begin; lane < end; lane++)
    for (long k = 0; k < rows; k++)
      for (int e = start[k]; e < start[k + 1]; e++) x[lane * size + term[e]] += y[lane * rows + k];
}
