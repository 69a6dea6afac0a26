// Factors of the saddle-point matrix for eight lanes at a time.
//
// Generated before this text: sizes N_V, ROWS, MATRIX, tables of the elimination, and `matrix`. LU is without pivoting:
// rates before constraints, so that pivots are those of the mass matrix and of its Schur complement. A body without
// inertia about an axis has none worth the name: `reliable` tells whether the factors solve a known system.

namespace {
constexpr int N = N_V + ROWS, LANES = 8;
constexpr double INACCURATE = 1e-7;  // error of a rate that is one; multipliers of redundant rows may be anything

struct Block {
  V K[N * N], inverse[N];  // of the pivots
};

inline V absolute(V a) { return f_abs(a); }

inline V largest(const V* a, int n) {
  V m = spread(0.0);
  for (int i = 0; i < n; i++) {
    V x = absolute(a[i]);
    m = (x > m) | (x != x) ? x : m;  // a nan stays
  }
  return m;
}

// Factors K = L U in place, in the order and pattern of the tables; the inverse of each pivot is kept.
void factor(V* K, V* inverse) {
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const V inv = 1.0 / K[p * N + p];
    inverse[p] = inv;
    const int *beside = BESIDE + START[k], count = START[k + 1] - START[k];
    const V* Kp = K + p * N;
    for (int r = 0; r < count; r++) {
      V* Ki = K + beside[r] * N;
      const V f = Ki[p] * inv;
      Ki[p] = f;
      for (int c = 0; c < count; c++) Ki[beside[c]] -= f * Kp[beside[c]];
    }
  }
}

void solve(const V* K, const V* inverse, V* b) {
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const V y = b[p];
    for (int r = START[k]; r < START[k + 1]; r++) b[BESIDE[r]] -= K[BESIDE[r] * N + p] * y;
  }
  for (int k = N - 1; k >= 0; k--) {
    const int p = ORDER[k];
    V y = b[p];
    for (int c = START[k]; c < START[k + 1]; c++) y -= K[p * N + BESIDE[c]] * b[BESIDE[c]];
    b[p] = y * inverse[p];
  }
}

void fill(const In& in, const double* stay, const double* lost, V* K, V* w, V* entries) {
  matrix(in, w, entries);
  std::memset((void*)K, 0, N * N * sizeof(V));
  for (int e = 0; e < MATRIX; e++) K[PLACES[e]] = entries[e];
  if (!stay) return;
  for (int i = 0; i < N; i++) {
    for (int j = 0; j < N; j++) K[i * N + j] *= stay[i] * stay[j];
    K[i * N + i] -= lost[i];
  }
}

void renew(const In& in, const double* stay, const double* lost, Block& block, V* w, V* entries) {
  fill(in, stay, lost, block.K, w, entries);
  factor(block.K, block.inverse);
}

// Renews the factors and solves for the row sums: all rates must come out as one. A lane whose matrix is nan says nothing.
bool reliable(const In& in, const double* stay, const double* lost, Block& block, V* w, V* entries) {
  V b[N], sound = spread(0.0);
  fill(in, stay, lost, block.K, w, entries);
  for (int i = 0; i < N; i++) {
    b[i] = spread(0.0);
    for (int j = 0; j < N; j++) b[i] += block.K[i * N + j];
    sound += 0.0 * b[i];
  }
  factor(block.K, block.inverse);
  solve(block.K, block.inverse, b);
  bool good = true;
  for (int i = 0; i < N_V; i++)
    for (int l = 0; l < LANES; l++) good &= sound[l] != 0.0 || std::fabs(b[i][l] - 1.0) <= INACCURATE;
  return good;
}

// One number of all lanes of a block, of which `valid` exist, to the record [..., lanes].
inline void put(double* to, V x, int valid) { std::memcpy(to, &x, valid * sizeof(double)); }
}  // namespace
