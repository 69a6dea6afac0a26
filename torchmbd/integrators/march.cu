// Steps of generalized-alpha, one thread for each lane: what march.cpp does, on arrays as torch has them, lanes last.
//
// Before this text stand, generated, sizes, tables of the elimination and the functions that march.cpp calls (code.py).
// Numbers of a lane lie `lanes` apart, so that threads beside each other read beside each other.

constexpr int N = N_V + ROWS, N_X = N_Q + 3 * N_V + ROWS;
constexpr int MOST = 4;              // as in march.py
constexpr double INACCURATE = 1e-7;  // as in factors.cpp

struct Job {                                                    // 8 bytes each, in this order
  long lanes, slots, data, uniform;                             // numbers of each
  long first, steps, corrections, most, refresh, look, fresh;   // look: at tangents; fresh: no factors yet
  long moving;                                                  // the last of the data, which change from step to step
  const double* given;                                          // [steps][uniform]
  double *state;                                                // [N_X][1 + slots][lanes], in and out
  double *values, *tangents;                                    // [data][lanes], [data][slots][lanes]
  double *factors;                                              // [N N + N][lanes]: L and U, inverses of pivots
  const double *stay, *lost;                                    // [N], or null
  double *q, *v, *vd, *lam;                                     // records [steps][number][1 + slots][lanes]
  double *sizes, *errors;                                       // [steps][2][lanes], [3][slots][lanes]
  double* room;                                                 // [room()][lanes]
  const double* moved;                                          // [steps][moving][1 + slots][lanes]
  const double* passes;                                         // [lanes], corrections of tangents; `most` of all
  double* doubt;                                                // [lanes], of `doubts`: 1 where factors are not reliable
};

// What a thread works with.
struct Lane {
  const Job& J;
  long l;
  In in;
  Room w, b, R, z, entries, dz, next, K, inverse;

  MEMBER Lane(const Job& job, long lane) : J(job), l(lane) {
    w = {J.room + l, J.lanes};
    b = w + ROOM, R = b + BOUNDARY, z = R + N, entries = z + N, dz = entries + MATRIX, next = dz + N * J.slots;
    K = {J.factors + l, J.lanes};
    inverse = K + N * N;
    in.d = {J.values + l, J.lanes};
    in.z = z, in.b = b;
  }
  // Slot s of an array [number][1 + slots][lanes].
  MEMBER Room of(double* a, long s) const { return {a + s * J.lanes + l, (1 + J.slots) * J.lanes}; }
};

DEVICE void copy(Room to, Room from, int n) {
  for (int i = 0; i < n; i++) to[i] = from[i];
}

DEVICE double largest(Room a, int n) {
  double m = 0.0;
  for (int i = 0; i < n; i++) {
    const double x = f_abs(a[i]);
    m = x > m || x != x ? x : m;  // a nan stays
  }
  return m;
}

// Unknowns (v', lam) that a step starts from: those of the state.
DEVICE void start(Room x, Room z) {
  copy(z, x + (N_Q + N_V), N_V);
  copy(z + N_V, x + (N_Q + 3 * N_V), ROWS);
}

PART solve(Room K, Room inverse, Room b) {
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const double y = b[p];
    for (int r = START[k]; r < START[k + 1]; r++) b[BESIDE[r]] -= K[BESIDE[r] * N + p] * y;
  }
  for (int k = N - 1; k >= 0; k--) {
    const int p = ORDER[k];
    double y = b[p];
    for (int c = START[k]; c < START[k + 1]; c++) y -= K[p * N + BESIDE[c]] * b[BESIDE[c]];
    b[p] = y * inverse[p];
  }
}

PART fill(Lane& a) {
  matrix(a.in, a.w, a.entries);
  for (int i = 0; i < N * N; i++) a.K[i] = 0.0;
  for (int e = 0; e < MATRIX; e++) a.K[PLACES[e]] = a.entries[e];
  if (!a.J.stay) return;
  for (int i = 0; i < N; i++) {
    for (int j = 0; j < N; j++) a.K[i * N + j] *= a.J.stay[i] * a.J.stay[j];
    a.K[i * N + i] -= a.J.lost[i];
  }
}

PART factor(Room K, Room inverse) {
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const double inv = 1.0 / K[p * N + p];
    inverse[p] = inv;
    for (int r = START[k]; r < START[k + 1]; r++) {
      const int i = BESIDE[r];
      const double f = K[i * N + p] * inv;
      K[i * N + p] = f;
      for (int c = START[k]; c < START[k + 1]; c++) K[i * N + BESIDE[c]] -= f * K[p * N + BESIDE[c]];
    }
  }
}

DEVICE void renew(Lane& a) {
  fill(a);
  factor(a.K, a.inverse);
}

// The data that move, as they are at the end of a step.
DEVICE void move(Lane& a, long step) {
  const Job& J = a.J;
  const long n = J.moving, L = J.lanes, S = J.slots;
  for (long i = 0; i < n; i++)
    for (long s = 0; s <= S; s++) {
      const double x = J.moved[((step * n + i) * (1 + S) + s) * L + a.l];
      (s ? J.tangents + ((J.data - n + i) * S + s - 1) * L : J.values + (J.data - n + i) * L)[a.l] = x;
    }
}

DEVICE void values(Lane& a, long i, bool fresh) {
  const Job& J = a.J;
  const bool always = J.refresh == 0, due = always || (J.first + i) % J.refresh == 0;
  const long renewed = J.corrections > 1 ? (J.corrections - 1 > 1 ? J.corrections - 1 : 1) : -1;
  if (fresh) renew(a);
  for (long k = 0; k < J.corrections; k++) {
    if (always || (due && k == renewed)) renew(a);
    residual(a.in, a.w, a.R);
    solve(a.K, a.inverse, a.R);
    for (int n = 0; n < N; n++) a.z[n] -= a.R[n];
    const double size = largest(a.R, N_V);
    if (k == J.corrections - 1) J.sizes[(2 * i + 1) * J.lanes + a.l] = size;
    if (k == J.corrections - 2 || J.corrections == 1) J.sizes[2 * i * J.lanes + a.l] = size;
  }
  if (due && J.corrections == 1) renew(a);
  finish(a.in, a.w, a.next);
}

DEVICE void tangents(Lane& a, long s, bool looks, bool begins) {
  const Job& J = a.J;
  const Room ds = a.dz + N * s;
  a.in.dx = a.of(J.state, 1 + s);
  a.in.dd = {J.tangents + s * J.lanes + a.l, J.slots * J.lanes};
  a.in.dz = ds;
  start(a.in.dx, ds);
  for (long k = 0; k < J.most + looks + (begins ? MOST : 0); k++) {
    residual_tangent(a.in, a.w, a.R);
    solve(a.K, a.inverse, a.R);
    const double share = k >= J.most || J.passes[a.l] > (double)k ? 1.0 : 0.0;
    for (int n = 0; n < N; n++) ds[n] -= share * a.R[n];
    if (!looks || k != J.most) continue;
    J.errors[s * J.lanes + a.l] = largest(a.R, N_V);
    J.errors[(J.slots + s) * J.lanes + a.l] = largest(ds, N_V);
    J.errors[(2 * J.slots + s) * J.lanes + a.l] = largest(ds + N_V, ROWS);
  }
  finish_tangent(a.in, a.w, a.next + N_X * (1 + s));
}

// The new state to its place and to the record.
DEVICE void keep(Lane& a, long i) {
  const Job& J = a.J;
  const long row = (1 + J.slots) * J.lanes;
  for (long s = 0; s <= J.slots; s++) {
    const Room x = a.next + N_X * s;
    copy(a.of(J.state, s), x, N_X);
    copy(a.of(J.q + i * N_Q * row, s), x, N_Q);
    copy(a.of(J.v + i * N_V * row, s), x + N_Q, N_V);
    copy(a.of(J.vd + i * N_V * row, s), x + (N_Q + N_V), N_V);
    copy(a.of(J.lam + i * ROWS * row, s), x + (N_Q + 3 * N_V), ROWS);
  }
}

KERNEL march(const Job* job) {
  const long l = (long)blockIdx.x * blockDim.x + threadIdx.x;
  if (l >= job->lanes) return;
  Lane a(*job, l);
  const Job& J = a.J;
  for (long i = 0; i < J.steps; i++) {
    const bool begins = J.fresh && i == 0;
    a.in.u = J.given + i * J.uniform;
    a.in.x = a.of(J.state, 0);
    move(a, i);
    start(a.in.x, a.z);
    values(a, i, begins);
    if (J.slots) boundary(a.in, a.w, a.b);
    for (long s = 0; s < J.slots; s++) tangents(a, s, J.look && i == 0, begins);
    keep(a, i);
  }
}

// Makes factors and solves for the row sums: all rates must come out as one. A lane whose matrix is nan says nothing.
KERNEL doubts(const Job* job) {
  const long l = (long)blockIdx.x * blockDim.x + threadIdx.x;
  if (l >= job->lanes) return;
  Lane a(*job, l);
  double sound = 0.0, doubt = 0.0;
  a.K = a.next, a.inverse = a.K + N * N;  // the factors in use stay
  a.in.u = a.J.given;
  a.in.x = a.of(a.J.state, 0);
  move(a, 0);
  start(a.in.x, a.z);
  fill(a);
  for (int i = 0; i < N; i++) {
    a.R[i] = 0.0;
    for (int j = 0; j < N; j++) a.R[i] += a.K[i * N + j];
    sound += 0.0 * a.R[i];
  }
  factor(a.K, a.inverse);
  solve(a.K, a.inverse, a.R);
  for (int i = 0; i < N_V; i++)
    if (sound == 0.0 && !(f_abs(a.R[i] - 1.0) <= INACCURATE)) doubt = 1.0;
  a.J.doubt[l] = doubt;
}

// Numbers of a lane in `room`, without those of each slot: N of tangents, and N_X of the new state, which `doubts` extends.
KERNEL room(long* size) { *size = ROOM + BOUNDARY + MATRIX + 2 * N; }
