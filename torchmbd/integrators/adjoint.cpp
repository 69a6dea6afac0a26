// The steps of march.cpp in reverse mode, from the last to the first, for eight lanes at a time: see adjoint.py.
//
// Before this text stand factors.cpp and, generated, the sizes N_Q, BOUNDARY, ROOM and (code.py)
//   boundary          what the others need of the values
//   pull_end          derivatives of y' finish by z and x, those that are not zero; PULL_END of them, at PULL_END_AT
//   pull_unknowns     of mu' residual by z
//   pull_known        of mu' residual by x and data
// If factors cannot be relied on, `adjoint` returns 1 and its results mean nothing.

constexpr int N_X = N_Q + 3 * N_V + ROWS;  // a state: q, v, v', a, lam
constexpr int MOST = 12;                   // corrections of mu, as in adjoint.py
constexpr long CHECK = 25;                 // steps between two looks at the factors, as in march.py
constexpr double ENOUGH = 1e-8;            // estimated relative error of mu that gets no other
constexpr double TINY = 1e-300;
enum { SHARE, A_FROM_VD, A_FROM_A };       // places among what all lanes share: the first weights of step.py

struct Job {
  long lanes, rows, data, uniform, steps, moving;  // numbers of each; moving: last of the data, which change with the step
  const double *given;                             // [steps][uniform]
  const double *recorded[4];                       // q, v, v', lam [steps + 1][number][1][lanes]
  const double *bars[4];                           // what responses take from them [steps + 1][number][rows][lanes], or null
  const double *start;                             // a at the start [block][N_V][8]
  double *values;                                  // [block][data][8]
  const double *moved;                             // [steps][block][1 + any][moving][8]
  const double *stay, *lost;                       // [N], or null
  const double *nothing;                           // [block][8], see march.py
  double *slopes, *moved_slopes;                   // [block][rows][data][8], [steps][block][rows][moving][8], zeros
  double *state_slopes;                            // [block][rows][N_X][8], in: by the last state, out: by the first
  double *error;                                   // [block][8], estimated relative error of mu
  double *room;                                    // scratch
  long moved_slots, corrections;                   // 1 + any; of mu, at least
  const void *mechanism;                           // of loops (native/)
};

extern "C" long adjoint_room(const void*, long rows, long steps) {
  const long numbers = ROOM + BOUNDARY + 4 * N + N_X + MATRIX + PULL_END + PULL_UNKNOWNS + PULL_KNOWN;
  return (long)sizeof(Block) + (long)sizeof(V) * (numbers + rows * N_X + (steps + 1) * N_V + 64);
}

// Solves with the transposed matrix.
static void solve_transposed(const V* K, const V* inverse, V* b) {
  for (int k = 0; k < N; k++) {
    const int p = ORDER[k];
    const V y = b[p] *= inverse[p];
    for (int c = START[k]; c < START[k + 1]; c++) b[BESIDE[c]] -= K[p * N + BESIDE[c]] * y;
  }
  for (int k = N - 1; k >= 0; k--) {
    const int p = ORDER[k];
    V y = b[p];
    for (int r = START[k]; r < START[k + 1]; r++) y -= K[BESIDE[r] * N + p] * b[BESIDE[r]];
    b[p] = y;
  }
}

constexpr int COUNT[] = {N_Q, N_V, N_V, ROWS}, AT[] = {0, N_Q, N_Q + N_V, N_Q + 3 * N_V};  // of q, v, v', lam in a state

// Eight lanes of a record, of which `valid` exist; the last of them stands for the others.
static inline V get(const double* from, int valid) {
  V x = spread(from[valid - 1]);
  std::memcpy(&x, from, valid * sizeof(double));
  return x;
}

// State i without its algorithmic acceleration.
static void state(const Job& J, long i, long block, int valid, V* x) {
  for (int k = 0; k < 4; k++)
    for (int n = 0; n < COUNT[k]; n++) x[AT[k] + n] = get(J.recorded[k] + (i * COUNT[k] + n) * J.lanes + block * LANES, valid);
}

// Adds what a response takes from state i.
static void take(const Job& J, long i, long s, long block, int valid, V* y) {
  for (int k = 0; k < 4; k++)
    for (int n = 0; J.bars[k] && n < COUNT[k]; n++)
      y[AT[k] + n] += get(J.bars[k] + ((i * COUNT[k] + n) * J.rows + s) * J.lanes + block * LANES, valid);
}

extern "C" long adjoint(const Job* job) {
  const Job& J = *job;
  const long S = J.rows, blocks = (J.lanes + LANES - 1) / LANES;
  V* w = (V*)J.room;
  Block& factors = *(Block*)(w + ROOM);
  V *b = (V*)(&factors + 1), *entries = b + BOUNDARY, *mu = entries + MATRIX, *goal = mu + N, *R = goal + N, *z = R + N;
  V *x = z + N, *end = x + N_X, *unknowns = end + PULL_END, *known = unknowns + PULL_UNKNOWNS;
  V *ys = known + PULL_KNOWN, *as = ys + S * N_X;
  for (long block = 0; block < blocks; block++) {
    const int valid = (int)(J.lanes - block * LANES < LANES ? J.lanes - block * LANES : LANES);
    V *values = (V*)J.values + block * J.data, *slopes = (V*)J.slopes + block * S * J.data;
    V worst = spread(0.0);
    const V nothing = ((const V*)J.nothing)[block];
    std::memcpy((void*)as, (const V*)J.start + block * N_V, N_V * sizeof(V));
    for (long i = 0; i < J.steps; i++) {
      const double* u = J.given + i * J.uniform;
      const double* vd = J.recorded[2] + i * N_V * J.lanes + block * LANES;
      for (int n = 0; n < N_V; n++) {
        const V before = get(vd + n * J.lanes, valid), after = get(vd + (N_V + n) * J.lanes, valid);
        as[(i + 1) * N_V + n] = u[A_FROM_VD] * before + u[A_FROM_A] * as[i * N_V + n] + u[SHARE] * after;
      }
    }
    std::memcpy((void*)ys, (const V*)J.state_slopes + block * S * N_X, S * N_X * sizeof(V));
    state(J, J.steps, block, valid, x);
    for (long i = J.steps - 1; i >= 0; i--) {
      if (J.moving) {
        const V* from = (const V*)J.moved + (i * blocks + block) * J.moved_slots * J.moving;
        std::memcpy((void*)(values + J.data - J.moving), from, J.moving * sizeof(V));
      }
      In in;
      in.u = J.given + i * J.uniform;
      in.d = values;
      in.b = b;
      in.mu = mu;
      std::memcpy((void*)z, x + AT[2], N_V * sizeof(V));
      std::memcpy((void*)(z + N_V), x + AT[3], ROWS * sizeof(V));
      in.z = z;
      state(J, i, block, valid, x);
      std::memcpy((void*)(x + N_Q + 2 * N_V), as + i * N_V, N_V * sizeof(V));
      in.x = x;
      if (i % CHECK == 0 && !reliable(in, J.stay, J.lost, factors, w, entries)) return 1;
      if (i % CHECK) renew(in, J.stay, J.lost, factors, w, entries);
      boundary(in, w, b);
      for (long s = 0; s < S; s++) {
        V *y = ys + s * N_X, *own = slopes + s * J.data;
        in.y = y;
        pull_end(in, w, end);
        std::memset((void*)goal, 0, N * sizeof(V));
        std::memset((void*)y, 0, N_X * sizeof(V));
        for (int e = 0; e < PULL_END; e++) {
          const int to = PULL_END_AT[e];
          (to < N ? goal[to] : y[to - N]) += end[e];
        }
        std::memcpy((void*)mu, goal, N * sizeof(V));
        solve_transposed(factors.K, factors.inverse, mu);
        V share = spread(1.0), left = spread(0.0), before = spread(1.0);
        for (long k = 1; k <= MOST || k <= J.corrections; k++) {
          pull_unknowns(in, w, unknowns);
          for (int n = 0; n < N; n++) R[n] = -goal[n];
          for (int e = 0; e < PULL_UNKNOWNS; e++) R[PULL_UNKNOWNS_AT[e]] += unknowns[e];
          solve_transposed(factors.K, factors.inverse, R);
          for (int n = 0; n < N; n++) mu[n] -= share * R[n];
          const V rates = largest(mu, N_V), held = nothing * largest(mu + N_V, ROWS), size = rates > held ? rates : held;
          const V change = largest(R, N_V) / (size > TINY ? size : spread(TINY));
          left = share > 0.0 ? change * change / before : left;  // each leaves the same share of what the one before left
          before = change > TINY ? change : spread(TINY);
          if (k >= J.corrections) share = left > ENOUGH ? share : spread(0.0);  // what a lane gets depends on no other
          bool done = true;
          for (int l = 0; l < LANES; l++) done &= share[l] == 0.0;
          if (done) break;
        }
        worst = (left > worst) | (left != left) ? left : worst;  // a nan stays
        pull_known(in, w, known);
        for (int e = 0; e < PULL_KNOWN; e++) {
          const int to = PULL_KNOWN_AT[e];
          (to < N_X ? y[to] : own[to - N_X]) -= known[e];
        }
        take(J, i, s, block, valid, y);
        if (!J.moving) continue;
        V* to = (V*)J.moved_slopes + ((i * blocks + block) * S + s) * J.moving;
        std::memcpy((void*)to, own + J.data - J.moving, J.moving * sizeof(V));
        std::memset((void*)(own + J.data - J.moving), 0, J.moving * sizeof(V));
      }
    }
    std::memcpy((V*)J.state_slopes + block * S * N_X, ys, S * N_X * sizeof(V));
    ((V*)J.error)[block] = worst;
  }
  return 0;
}
