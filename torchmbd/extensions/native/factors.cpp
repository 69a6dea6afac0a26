// Sizes and tables of a mechanism, and sparse factors of its saddle-point matrix, for LANES lanes at a time.
//
// Before this text stand the generated functions and N_Q, N_V, ROWS in terms of sizes n. LU is without pivoting: rates
// before constraints, so that pivots are those of the mass matrix and of its Schur complement. A body without inertia about
// an axis has none worth the name: `reliable` tells whether the factors solve a known system.

// Of one mechanism. Numbers of the matrix in memory, for each pivot: [pivot][its row, later pivots][its column, the same].
struct Mechanism {
  const long* sizes;               // in the order of struct N
  const int* const* tables;        // in the order of struct Tables
  const double* const* constants;  // in the order of point_constants
  long size;                       // numbers of the matrix in memory
  const int *order;                // unknown of each pivot
  const int *start;                // where the later unknowns that a pivot meets begin in `later`; [pivots + 1]
  const int *later, *later_pivots;  // these unknowns, and their pivots
  const int *base;                 // where the numbers of a pivot begin
  const int *target;               // of each entry of `later`: address of what its row meets next, or -1 - where addresses stand
  const int *scattered;            // these addresses
  long fills;                      // matrix[to] += factor entries[from]
  const int *to, *from;
  const double *factor;
  long products;                   // matrix[to] += factor weight first second
  const int *product_to, *weight, *first, *second;
  const double *product_factor;
  const int *row, *column;         // unknowns of every number of the matrix
  long called, pairs;              // actions whose laws are called back (feedback.cpp), and which strength depends on which
  const int *pair_to, *pair_from;
};

namespace {
enum { SCALE = 8, RATE = 9 };        // positions among the numbers of a step: weights of step.py
constexpr double INACCURATE = 1e-7;  // error of a rate that is one; multipliers of redundant rows may be anything

// Counts of a mechanism, and positions of scratch buffers.
struct Counts {
  N n;
  long o[BUFFERS], scratch, n_q, n_v, rows, unknowns, n_x, entries, data;
  explicit Counts(const Mechanism& m) {
    std::memcpy((void*)&n, m.sizes, sizeof(N));
    scratch = layout(n, o);
    n_q = N_Q;
    n_v = N_V;
    rows = ROWS;
    unknowns = n_v + rows;
    n_x = n_q + 3 * n_v + rows;
    entries = ENTRIES + m.pairs;
    data = DATA;
  }
};

void point(In& in, const Mechanism& m, const Counts& c, V* w) {
  in.n = c.n;
  in.o = c.o;
  in.w = w;
  std::memcpy((void*)&in.tables, m.tables, sizeof(Tables));
  point_constants(in, m.constants);
}

// The largest of n numbers by their sizes; weights: one over the size of each.
inline V largest(const V* a, const V* weights, long n) {
  V m = spread(0.0);
  for (long i = 0; i < n; i++) {
    V x = f_abs(a[i]) * weights[i];
    m = (x > m) | (x != x) ? x : m;  // a nan stays
  }
  return m;
}

// Factors in place, K = L U; the inverse of each pivot takes its place.
void factor(const Mechanism& m, long unknowns, V* K) {
  for (long k = 0; k < unknowns; k++) {
    const int *pivots = m.later_pivots + m.start[k], *target = m.target + m.start[k], count = m.start[k + 1] - m.start[k];
    V *own = K + m.base[k], *U = own + 1, *L = U + count;
    const V inverse = 1.0 / own[0];
    own[0] = inverse;
    for (int r = 0; r < count; r++) L[r] *= inverse;
    for (int r = 0; r < count; r++) {
      const int i = pivots[r], length = m.start[i + 1] - m.start[i];
      const V l = L[r], u = U[r];
      K[m.base[i]] -= l * u;
      if (target[r] >= 0) {
        V *row = K + target[r] - (r + 1), *column = row + length;
        for (int c = r + 1; c < count; c++) {
          row[c] -= l * U[c];
          column[c] -= L[c] * u;
        }
      } else {
        const int* addresses = m.scattered - 1 - target[r] - (r + 1);
        for (int c = r + 1; c < count; c++) {
          V* row = K + addresses[c];
          row[0] -= l * U[c];
          row[length] -= L[c] * u;
        }
      }
    }
  }
}

void solve(const Mechanism& m, long unknowns, const V* K, V* b) {
  for (long k = 0; k < unknowns; k++) {
    const int *later = m.later + m.start[k], count = m.start[k + 1] - m.start[k];
    const V *L = K + m.base[k] + 1 + count, y = b[m.order[k]];
    for (int r = 0; r < count; r++) b[later[r]] -= L[r] * y;
  }
  for (long k = unknowns - 1; k >= 0; k--) {
    const int *later = m.later + m.start[k], count = m.start[k + 1] - m.start[k];
    const V* own = K + m.base[k];
    V y = b[m.order[k]];
    for (int c = 0; c < count; c++) y -= own[1 + c] * b[later[c]];
    b[m.order[k]] = y * own[0];
  }
}

// Solves with the transposed matrix.
[[maybe_unused]] void solve_transposed(const Mechanism& m, long unknowns, const V* K, V* b) {
  for (long k = 0; k < unknowns; k++) {
    const int *later = m.later + m.start[k], count = m.start[k + 1] - m.start[k];
    const V* own = K + m.base[k];
    const V y = b[m.order[k]] *= own[0];
    for (int c = 0; c < count; c++) b[later[c]] -= own[1 + c] * y;
  }
  for (long k = unknowns - 1; k >= 0; k--) {
    const int *later = m.later + m.start[k], count = m.start[k + 1] - m.start[k];
    const V* L = K + m.base[k] + 1 + count;
    V y = b[m.order[k]];
    for (int r = 0; r < count; r++) y -= L[r] * b[later[r]];
    b[m.order[k]] = y;
  }
}

// The matrix at the values of `in`; in.entries is scratch. row_mask, diagonal_shift: see Dynamics.diagonal.
void fill(const In& in, const Mechanism& m, const double* row_mask, const double* diagonal_shift, V* K) {
  matrix(in);
  V* entries = in.entries;
  const N& n = in.n;
  (void)n;
  for (long p = 0; m.products && p < m.pairs; p++)  // as of laws that are written out
    entries[ENTRIES + p] = -(in.u[SCALE] * in.slopes[p] + in.u[RATE] * in.slopes[m.pairs + p]);
  std::memset((void*)K, 0, m.size * sizeof(V));
  for (long e = 0; e < m.fills; e++) K[m.to[e]] += m.factor[e] * entries[m.from[e]];
  for (long e = 0; e < m.products; e++)
    K[m.product_to[e]] += m.product_factor[e] * entries[m.weight[e]] * entries[m.first[e]] * entries[m.second[e]];
  if (!row_mask) return;
  for (long e = 0; e < m.size; e++) {
    K[e] *= row_mask[m.row[e]] * row_mask[m.column[e]];
    if (m.row[e] == m.column[e]) K[e] -= diagonal_shift[m.row[e]];
  }
}

void renew(const In& in, const Mechanism& m, long unknowns, const double* row_mask, const double* diagonal_shift, V* K) {
  fill(in, m, row_mask, diagonal_shift, K);
  factor(m, unknowns, K);
}

// Renews the factors and solves a system whose solution is known: all unknowns have their sizes, which the rates must come out
// with. weights: one over these sizes. A lane whose matrix is nan says nothing, nor does one whose iterations do not converge
// (counted: 2 where they do).
bool reliable(const In& in, const Mechanism& m, const Counts& c, const double* row_mask, const double* diagonal_shift,
              const V& counted, const V* weights, V* K, V* b) {
  V sound = spread(0.0);
  fill(in, m, row_mask, diagonal_shift, K);
  std::memset((void*)b, 0, c.unknowns * sizeof(V));
  for (long e = 0; e < m.size; e++) {
    b[m.row[e]] += K[e] / weights[m.column[e]];
    sound += 0.0 * K[e];
  }
  factor(m, c.unknowns, K);
  solve(m, c.unknowns, K, b);
  bool good = true;
  for (long i = 0; i < c.n_v; i++)
    for (int l = 0; l < LANES; l++) good &= counted[l] != 2.0 || sound[l] != 0.0 || std::fabs(b[i][l] * weights[i][l] - 1.0) <= INACCURATE;
  return good;
}

// One number of all lanes of a block, of which `valid` exist, to the record [..., lanes].
inline void put(double* to, V x, int valid) { std::memcpy(to, &x, valid * sizeof(double)); }
}  // namespace
