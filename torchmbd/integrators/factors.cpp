// Factors of the saddle-point matrix for eight lanes at a time.
//
// Generated before this text: sizes N_V, ROWS, MATRIX, tables of the elimination, and `matrix`. LU is without pivoting:
// rates before constraints, so that pivots are those of the mass matrix and of its Schur complement. A body without
// inertia has none: `renew` then returns true and nothing is to be used.

namespace {
constexpr int N = N_V + ROWS, LANES = 8;
constexpr double SMALL = 1e-12;  // of the diagonal: a pivot of a rate that is rounding only

struct Block {
  V K[N * N], diagonal[N];
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
bool factor(V* K, V* inverse) {
  bool massless = false;
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const V before = inverse[p], pivot = K[p * N + p];
    if (p < N_V) {
      for (int l = 0; l < LANES; l++) massless |= std::fabs(pivot[l]) <= SMALL * std::fabs(before[l]);
    }
    const V inv = 1.0 / pivot;
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
  return massless;
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

bool renew(const In& in, const double* stay, const double* lost, Block& block, V* w, V* entries) {
  matrix(in, w, entries);
  std::memset((void*)block.K, 0, sizeof(block.K));
  for (int e = 0; e < MATRIX; e++) block.K[PLACES[e]] = entries[e];
  if (stay) {
    for (int i = 0; i < N; i++) {
      for (int j = 0; j < N; j++) block.K[i * N + j] *= stay[i] * stay[j];
      block.K[i * N + i] -= lost[i];
    }
  }
  for (int i = 0; i < N; i++) block.diagonal[i] = block.K[i * N + i];
  return factor(block.K, block.diagonal);
}

// One number of all lanes of a block, of which `valid` exist, to the record [..., lanes].
inline void put(double* to, V x, int valid) { std::memcpy(to, &x, valid * sizeof(double)); }
}  // namespace
