// The steps of steps.cpp in reverse mode, from the last to the first, for LANES lanes at a time: see adjoint.py.
//
// Before this text stand factors.cpp, feedback.cpp and, generated (functions.py),
//   matrix, boundary  the iteration matrix, and what the others need of the values
//   pull_end          adds derivatives of y' finish by z and x
//   pull_unknowns     of mu' residual by z
//   pull_known        of -mu' residual by x and data
//   signals           what laws that are called back read, and
//   pull_signals_unknowns, pull_signals_known: its derivatives by z, by x and data
// Strengths and slopes of such laws are known at all steps before; what they read there, from a first call (`read`).
// `adjoint` works on blocks from `begin` to `end`, which share nothing, with scratch memory of the thread.
// If factors cannot be relied on, it returns 1 and its results mean nothing.

constexpr int MOST = 12;                   // corrections of mu, as in adjoint.py
constexpr long CHECK = 25;                 // steps between two checks of the factors, as in stepper.py
constexpr double ENOUGH = 1e-8;            // estimated relative error of mu that gets no other
constexpr double NEGLIGIBLE = 1e-9;         // as in pullback.py
constexpr double TINY = 1e-300;
enum { SHARE, A_FROM_VD, A_FROM_A };       // positions among the numbers of a step: the first weights of step.py

struct Job {
  long lanes, rows, data, prescribed, steps, moving;  // numbers of each; moving: last of the data, which change with the step
  const double *shared;                            // [steps][prescribed][LANES], weights and what drives prescribe
  const double *recorded[4];                       // q, v, v', lam [steps + 1][number][1][lanes]
  const double *of_motion[4];                           // what responses take from them [steps + 1][number][rows][lanes], or null
  const double *start;                             // a at the start [block][N_V][LANES]
  double *values;                                  // [block][data][LANES]
  const double *moved;                             // [steps][block][1 + any][moving][LANES]
  const double *row_mask, *diagonal_shift;         // [N], or null
  const double *weights;                           // [block][N][LANES], one over the size of each unknown
  double *slopes, *moved_slopes;                   // [block][rows][data][LANES], [steps][block][rows][moving][LANES], zeros
  double *state_slopes;                            // [block][rows][N_X][LANES], in: by the last state, out: by the first
  double *error;                                   // [block][LANES], estimated relative error of mu
  long moved_columns, corrections;                 // 1 + any; of mu, at least
  const Mechanism *mechanism;
  long read;                                       // only the signals are wanted: no rows, no strengths
  double *signals;                                 // [steps][block][2 called][LANES]
  double *strengths, *law_slopes;                  // [steps][block][called][LANES], [steps][block][2][pairs][LANES]
  double *strength_bars;                           // [steps][block][rows][called][LANES], out
};

// Bytes of scratch memory.
extern "C" long adjoint_scratch(const Mechanism* m, long rows, long steps) {
  const Counts c(*m);
  return sizeof(V) * (m->size + c.scratch + c.entries + 4 * c.unknowns + c.n_x * (2 + rows) + (steps + 1) * c.n_v + 2 * m->called);
}

// Counts and positions of q, v, v', lam in a state.
struct Parts {
  long count[4], at[4];
  explicit Parts(const Counts& c) : count{c.n_q, c.n_v, c.n_v, c.rows}, at{0, c.n_q, c.n_q + c.n_v, c.n_q + 3 * c.n_v} {}
};

// A block of lanes of a record, of which `valid` exist; the last of them stands for the others.
static inline V get(const double* from, int valid) {
  V x = spread(from[valid - 1]);
  std::memcpy(&x, from, valid * sizeof(double));
  return x;
}

// State i without its algorithmic acceleration.
static void state(const Job& J, const Parts& p, long i, long block, int valid, V* x) {
  for (int k = 0; k < 4; k++)
    for (long n = 0; n < p.count[k]; n++)
      x[p.at[k] + n] = get(J.recorded[k] + (i * p.count[k] + n) * J.lanes + block * LANES, valid);
}

// Adds what a response takes from state i.
static void take(const Job& J, const Parts& p, long i, long s, long block, int valid, V* y) {
  for (int k = 0; k < 4; k++)
    for (long n = 0; J.of_motion[k] && n < p.count[k]; n++)
      y[p.at[k] + n] += get(J.of_motion[k] + ((i * p.count[k] + n) * J.rows + s) * J.lanes + block * LANES, valid);
}

extern "C" long adjoint(const Job* job, long begin, long end, double* scratch) {
  const Job& J = *job;
  const long S = J.rows, blocks = (J.lanes + LANES - 1) / LANES;
  const Mechanism& m = *J.mechanism;
  const Counts c(m);
  const Parts p(c);
  const long N_ = c.unknowns, n_x = c.n_x;
  V* w = (V*)scratch;
  V *K = w + c.scratch, *entries = K + m.size, *mu = entries + c.entries, *goal = mu + N_, *R = goal + N_, *z = R + N_;
  V *x = z + N_, *before_y = x + n_x, *ys = before_y + n_x, *as = ys + S * n_x, *worth = as + (J.steps + 1) * c.n_v;
  In in;
  point(in, m, c, w);
  in.entries = entries;
  in.mu = mu;
  in.z = z;
  for (long block = begin; block < end; block++) {
    const int valid = (int)(J.lanes - block * LANES < LANES ? J.lanes - block * LANES : LANES);
    V *values = (V*)J.values + block * J.data, *slopes = (V*)J.slopes + block * S * J.data;
    V worst = spread(0.0);
    const V* weights = (const V*)J.weights + block * N_;
    std::memcpy((void*)as, (const V*)J.start + block * c.n_v, c.n_v * sizeof(V));
    for (long i = 0; i < J.steps; i++) {
      const V* u = (const V*)J.shared + i * J.prescribed;
      const double* vd = J.recorded[2] + i * c.n_v * J.lanes + block * LANES;
      for (long n = 0; n < c.n_v; n++) {
        const V before = get(vd + n * J.lanes, valid), after = get(vd + (c.n_v + n) * J.lanes, valid);
        as[(i + 1) * c.n_v + n] = u[A_FROM_VD] * before + u[A_FROM_A] * as[i * c.n_v + n] + u[SHARE] * after;
      }
    }
    std::memcpy((void*)ys, (const V*)J.state_slopes + block * S * n_x, S * n_x * sizeof(V));
    state(J, p, J.steps, block, valid, x);
    for (long i = J.steps - 1; i >= 0; i--) {
      if (J.moving) {
        const V* from = (const V*)J.moved + (i * blocks + block) * J.moved_columns * J.moving;
        std::memcpy((void*)(values + J.data - J.moving), from, J.moving * sizeof(V));
      }
      in.u = (const V*)J.shared + i * J.prescribed;
      point_data(in, values);
      std::memcpy((void*)z, x + p.at[2], c.n_v * sizeof(V));
      std::memcpy((void*)(z + c.n_v), x + p.at[3], c.rows * sizeof(V));
      state(J, p, i, block, valid, x);
      std::memcpy((void*)(x + c.n_q + 2 * c.n_v), as + i * c.n_v, c.n_v * sizeof(V));
      in.x = x;
      const long step = i * blocks + block;
      if (J.read) {
        in.signals = (V*)J.signals + step * 2 * m.called;
        signals(in);
        continue;
      }
      in.strengths = (const V*)J.strengths + step * m.called;
      if (m.called) in.slopes = (const V*)J.law_slopes + step * 2 * m.pairs;
      in.signal_bars = worth;
      if (i % CHECK == 0 && !reliable(in, m, c, J.row_mask, J.diagonal_shift, spread(2.0), weights, K, R)) return 1;
      if (i % CHECK) renew(in, m, N_, J.row_mask, J.diagonal_shift, K);
      boundary(in);
      for (long s = 0; s < S; s++) {
        V *y = ys + s * n_x, *own = slopes + s * J.data, *of_motion = (V*)J.strength_bars + (step * S + s) * m.called;
        std::memcpy((void*)before_y, y, n_x * sizeof(V));
        std::memset((void*)goal, 0, N_ * sizeof(V));
        std::memset((void*)y, 0, n_x * sizeof(V));
        in.y = before_y;
        in.z_bar = goal;
        in.x_bar = y;
        pull_end(in);
        std::memcpy((void*)mu, goal, N_ * sizeof(V));
        solve_transposed(m, N_, K, mu);
        V share = spread(1.0), left = spread(0.0), before = spread(1.0);
        for (long k = 1; k <= MOST || k <= J.corrections; k++) {
          for (long n = 0; n < N_; n++) R[n] = -goal[n];
          in.z_bar = R;
          in.strength_bars = of_motion;
          std::memset((void*)of_motion, 0, m.called * sizeof(V));
          pull_unknowns(in);
          if (m.called) {
            signal_bars(in, m, of_motion, worth);
            pull_signals_unknowns(in);
          }
          solve_transposed(m, N_, K, R);
          for (long n = 0; n < N_; n++) mu[n] -= share * R[n];
          const V rates = largest(mu, weights, c.n_v), held = NEGLIGIBLE * largest(mu + c.n_v, weights + c.n_v, c.rows);
          const V size = rates > held ? rates : held, change = largest(R, weights, c.n_v) / (size > TINY ? size : spread(TINY));
          left = share > 0.0 ? change * change / before : left;  // each leaves the same share of what the one before left
          before = change > TINY ? change : spread(TINY);
          if (k >= J.corrections) share = left > ENOUGH ? share : spread(0.0);  // what a lane gets depends on no other
          bool done = true;
          for (int l = 0; l < LANES; l++) done &= share[l] == 0.0;
          if (done) break;
        }
        worst = (left > worst) | (left != left) ? left : worst;  // a nan stays
        point_data_bars(in, own);
        std::memset((void*)of_motion, 0, m.called * sizeof(V));
        pull_known(in);
        if (m.called) {
          signal_bars(in, m, of_motion, worth);
          pull_signals_known(in);
        }
        take(J, p, i, s, block, valid, y);
        if (!J.moving) continue;
        V* to = (V*)J.moved_slopes + ((i * blocks + block) * S + s) * J.moving;
        std::memcpy((void*)to, own + J.data - J.moving, J.moving * sizeof(V));
        std::memset((void*)(own + J.data - J.moving), 0, J.moving * sizeof(V));
      }
    }
    std::memcpy((V*)J.state_slopes + block * S * n_x, ys, S * n_x * sizeof(V));
    ((V*)J.error)[block] = worst;
  }
  return 0;
}
