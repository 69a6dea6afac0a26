// Steps of one-step methods for LANES lanes at a time: what EagerStepper in stepper.py does, around generated code.
//
// Before this text stand factors.cpp, feedback.cpp and, generated,
//   signals, residual, finish, matrix, boundary, signal_tangents, residual_tangent, finish_tangent      (functions.py)
// A block is LANES lanes. Arrays of a block: state [column][number], data [number], tangents of data [tangent][number].
// `run_steps` works on blocks from `begin` to `end`, which share nothing, with scratch memory of the thread. Its status is 1 where
// new factors, or those of every CHECK steps, cannot be relied on: then the steps count for nothing; 2 where what was called back
// raised.

constexpr int MOST = 4, MORE = 6, CHECK = 25;  // as in stepper.py
constexpr double PRECISE = 1e-6, SOLVED = 1e-10;  // as in stepper.py
constexpr double ITERATION_ERROR = 1e-2;       // as in statistics.py

struct Job {
  long lanes, n_b, data, data_tangents, prescribed;              // numbers of each
  long first, steps, corrections, most, refresh, fresh;          // refresh: -1 as 0, from a uniform motion; fresh: no factors yet
  long moving;                                                   // the last of the data, which change from step to step
  long tables;                                                   // blocks of what is prescribed: all, or one that all lanes share
  const double *shared;                                          // [steps][tables][prescribed][LANES], weights and what drives prescribe
  double *state;                                                 // [block][1 + n_b][N_X][LANES], in and out
  double *values, *tangents;                                     // [block][data][LANES], [block][n_b][data_tangents][LANES]
  double *factors;                                               // [block][numbers of the matrix][LANES]
  const double *row_mask, *diagonal_shift;                       // [N], or null
  double *q, *v, *vd, *lam;                                      // records [steps][number][1 + n_b][lanes]
  double *sizes, *errors;                                        // [steps][3][lanes], [3][n_b][lanes]
  const double *moved;                                           // [steps][block][1 + n_b][moving][LANES]
  const Mechanism *mechanism;
  const double *passes;                                          // [block][LANES], corrections of tangents; `most` of all
  const Feedback *feedback;                                      // or null
  double *counted;                                               // [block][LANES]: 0 of lanes without a motion, 1, 2: iterations converge; in and out
  double *scale;                                                 // [block][LANES], largest accelerations so far, in and out
  const double *weights;                                         // [block][N][LANES], one over the size of each unknown
};

static bool any(const V& mask) {
  bool found = false;
  for (int l = 0; l < LANES; l++) found |= mask[l] != 0.0;
  return found;
}

// Bytes of scratch memory, and of the factors of a block.
extern "C" long steps_scratch(const Mechanism* m, long n_b) {
  const Counts c(*m);
  return sizeof(V) * (m->size + c.scratch + c.entries + (2 + n_b) * c.unknowns + (1 + n_b) * c.n_x);
}

extern "C" long steps_factors(const Mechanism* m) { return sizeof(V) * m->size; }

// Unknowns (v', lam) that a step starts from: those of the state.
static void start(const Counts& c, const V* x, V* z) {
  std::memcpy((void*)z, x + c.n_q + c.n_v, c.n_v * sizeof(V));
  std::memcpy((void*)(z + c.n_v), x + c.n_q + 3 * c.n_v, c.rows * sizeof(V));
}

// Those of a uniform motion, as Step.uniform in step.py; u: the numbers of the method, in the order of its Weights.
static void start_uniformly(const Counts& c, const V* x, const V* u, V* z) {
  start(c, x, z);
  const V *vd = x + c.n_q + c.n_v, *a = vd + c.n_v;
  const V by_vd = -u[5] * u[1] * u[10], by_a = -(u[4] + u[5] * u[2]) * u[10];
  for (long n = 0; n < c.n_v; n++) z[n] = by_vd * vd[n] + by_a * a[n];
}

// One where the next correction of values, as estimated from the last two, is no rounding (IterationErrors in stepper.py).
static V imprecise(const V& before, const V& last, const V& scale, const V& further) {
  const V one = spread(1.0), zero = spread(0.0), half = 0.5 * before, goal = scale * before;
  const V share = further > 0.0 ? (last < half ? spread(SOLVED) : spread(PRECISE)) : spread(PRECISE);
  return last * last > share * goal ? one : zero;  // zero of a lane that is nan
}

// The data that move, as they are at the end of a step.
static void move(const Job& J, long step, long block) {
  if (!J.moving) return;
  const long blocks = (J.lanes + LANES - 1) / LANES, n = J.moving;
  const V* from = (const V*)J.moved + (step * blocks + block) * (1 + J.n_b) * n;
  std::memcpy((void*)((V*)J.values + (block + 1) * J.data - n), from, n * sizeof(V));
  for (long s = 0; s < J.n_b; s++)
    std::memcpy((void*)((V*)J.tangents + (block * J.n_b + s + 1) * J.data_tangents - n), from + (s + 1) * n, n * sizeof(V));
}

// Weights of a step, and what drives prescribe at its end.
static const V* prescribed(const Job& J, long step, long block) {
  return (const V*)J.shared + (step * J.tables + (J.tables > 1 ? block : 0)) * J.prescribed;
}

// Scratch memory of a block, and what points to it.
struct Work {
  const Counts c;
  V *trial, *R, *z, *dz, *next;
  In in;
  Work(const Job& J, V* w) : c(*J.mechanism) {
    trial = w + c.scratch;
    R = trial + J.mechanism->size;
    z = R + c.unknowns;
    V* entries = z + c.unknowns;
    dz = entries + c.entries;
    next = dz + c.unknowns * J.n_b;
    point(in, *J.mechanism, c, w);
    in.R = R;
    in.z = z;
    in.entries = entries;
    if (J.mechanism->called) point_feedback(in, *J.feedback);
  }
};

// Marks the lanes of a block whose iterations did not converge in steps from `begin` to `end`.
static void mark_divergent(const Job& J, long begin, long end, long block, int valid, const V& scale, V& counted) {
  for (long i = begin; i < end; i++)
    for (int l = 0; l < valid; l++) {
      const double *before = J.sizes + 3 * i * J.lanes + block * LANES + l, last = before[J.lanes];
      if (counted[l] == 2.0 && !(last * last <= ITERATION_ERROR * scale[l] * *before)) counted[l] = 1.0;
    }
  for (int l = valid; l < LANES; l++) counted[l] = counted[valid - 1];
}

extern "C" long run_steps(const Job* job, long begin, long end, double* scratch) {
  const Job& J = *job;
  const int S = (int)J.n_b;
  const Mechanism& m = *J.mechanism;
  Work work(J, (V*)scratch);
  const Counts& c = work.c;
  const long N_ = c.unknowns, n_x = c.n_x;
  V *trial = work.trial, *R = work.R, *z = work.z, *dz = work.dz, *next = work.next;
  In& in = work.in;
  for (long block = begin; block < end; block++) {
    const int valid = (int)(J.lanes - block * LANES < LANES ? J.lanes - block * LANES : LANES);
    V* state = (V*)J.state + block * (1 + S) * n_x;
    const V* tangents = (const V*)J.tangents + block * S * J.data_tangents;
    V* factors = (V*)J.factors + block * m.size;
    point_data(in, (const V*)J.values + block * J.data);
    const V passes = ((const V*)J.passes)[block];
    const V* weights = (const V*)J.weights + block * N_;
    V& scale = ((V*)J.scale)[block];
    V& counted = ((V*)J.counted)[block];
    bool fresh = J.fresh;
    long marked = 0;
    for (long i = 0; i < J.steps; i++) {
      in.u = prescribed(J, i, block);
      move(J, i, block);
      in.x = state;
      in.next = next;
      in.R = R;
      const bool checks = (J.first + i) % CHECK == 0;
      if (checks || fresh) {
        mark_divergent(J, marked, i, block, valid, scale, counted);
        marked = i;
        start(c, state, z);
        if (ask(in, m, J.feedback, SLOPES, i, block)) return 2;
        if (!reliable(in, m, c, J.row_mask, J.diagonal_shift, counted, weights, trial, R)) return 1;
      }
      const bool always = J.refresh <= 0, due = always || (J.first + i) % J.refresh == 0;
      if (J.refresh < 0)
        start_uniformly(c, state, in.u, z);
      else
        start(c, state, z);
      const long renewed = J.corrections > 1 ? (J.corrections - 1 > 1 ? J.corrections - 1 : 1) : -1;
      if (fresh) {
        if (ask(in, m, J.feedback, SLOPES, i, block)) return 2;
        renew(in, m, N_, J.row_mask, J.diagonal_shift, factors);
      }
      const bool begins = fresh;
      fresh = false;
      V before = spread(0.0), last_size = before;
      for (long k = 0; k < J.corrections; k++) {
        const bool anew = always || (due && k == renewed);
        if (ask(in, m, J.feedback, anew ? SLOPES : STRENGTHS, i, block)) return 2;
        if (anew) renew(in, m, N_, J.row_mask, J.diagonal_shift, factors);
        residual(in);
        solve(m, N_, factors, R);
        for (long n = 0; n < N_; n++) z[n] -= R[n];
        before = last_size;
        last_size = largest(R, weights, c.n_v);
        if (k == 0) before = last_size;
      }
      const V reached = largest(z, weights, c.n_v);
      scale = reached > scale ? reached : scale;
      V further = spread(0.0);
      V open = counted != 0.0 ? imprecise(before, last_size, scale, further) : spread(0.0);
      for (long k = 0; k < MORE && any(open); k++) {  // of some lanes alone, each with a matrix of its own
        if (ask(in, m, J.feedback, SLOPES, i, block)) return 2;
        renew(in, m, N_, J.row_mask, J.diagonal_shift, trial);
        residual(in);
        solve(m, N_, trial, R);
        for (long n = 0; n < N_; n++) z[n] = open != 0.0 ? z[n] - R[n] : z[n];
        for (long e = 0; e < m.size; e++) factors[e] = open != 0.0 ? trial[e] : factors[e];
        further += open;
        before = open != 0.0 ? last_size : before;
        last_size = open != 0.0 ? largest(R, weights, c.n_v) : last_size;
        open = open != 0.0 ? imprecise(before, last_size, scale, further) : open;
      }
      put(J.sizes + 3 * i * J.lanes + block * LANES, before, valid);
      put(J.sizes + (3 * i + 1) * J.lanes + block * LANES, last_size, valid);
      put(J.sizes + (3 * i + 2) * J.lanes + block * LANES, further, valid);
      const bool last = due && J.corrections == 1;
      if ((S || last) && ask(in, m, J.feedback, S ? TANGENTS : SLOPES, i, block)) return 2;
      if (last) renew(in, m, N_, J.row_mask, J.diagonal_shift, factors);
      finish(in);
      if (S) boundary(in);
      for (int s = 0; s < S; s++) {
        V* ds = dz + N_ * s;
        in.dx = state + (1 + s) * n_x;
        point_data_tangents(in, tangents + s * J.data_tangents);
        in.dz = ds;
        start(c, in.dx, ds);
        for (long k = 0; k < J.most + checks + (begins ? MOST : 0); k++) {
          if (m.called) {
            signal_tangents(in);
            strength_tangents(in, m, J.feedback, s);
          }
          residual_tangent(in);
          solve(m, N_, factors, R);
          const V done = spread(k < J.most ? (double)k : -1.0), share = passes > done ? spread(1.0) : spread(0.0);
          for (long n = 0; n < N_; n++) ds[n] -= share * R[n];
          if (!checks || k != J.most) continue;
          put(J.errors + s * J.lanes + block * LANES, largest(R, weights, c.n_v), valid);
          put(J.errors + (S + s) * J.lanes + block * LANES, largest(ds, weights, c.n_v), valid);
          put(J.errors + (2 * S + s) * J.lanes + block * LANES, largest(ds + c.n_v, weights + c.n_v, c.rows), valid);
        }
        in.next = next + (1 + s) * n_x;
        finish_tangent(in);
      }
      std::memcpy((void*)state, next, (1 + S) * n_x * sizeof(V));
      const long L = J.lanes, at = block * LANES;
      for (int s = 0; s <= S; s++) {
        const V* x = state + s * n_x;
        for (long n = 0; n < c.n_q; n++) put(J.q + ((i * c.n_q + n) * (1 + S) + s) * L + at, x[n], valid);
        for (long n = 0; n < c.n_v; n++) {
          put(J.v + ((i * c.n_v + n) * (1 + S) + s) * L + at, x[c.n_q + n], valid);
          put(J.vd + ((i * c.n_v + n) * (1 + S) + s) * L + at, x[c.n_q + c.n_v + n], valid);
        }
        for (long n = 0; n < c.rows; n++) put(J.lam + ((i * c.rows + n) * (1 + S) + s) * L + at, x[c.n_q + 3 * c.n_v + n], valid);
      }
    }
    mark_divergent(J, marked, J.steps, block, valid, scale, counted);
  }
  return 0;
}
