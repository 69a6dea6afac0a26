// The start of motions for LANES lanes at a time: solutions with the saddle-point matrix at a state, and their derivatives in
// reverse mode.
//
// Before this text stand factors.cpp and, generated (functions.py),
//   matrix             of the accelerations
//   accelerations      residual at z = 0, or
//   third_rates        the same of a vector along M^-1 Phi_q' (smooth_start.py), whose factors are the first numbers of `shared`
//   boundary           what the others need of the values
//   pull_accelerations, pull_third_rates: add derivatives of mu' residual by x and data
// One call has columns: solutions with one matrix, each with factors of its own. `start` works on blocks from `begin` to `end`.
// If the factors cannot be relied on, it returns 1 and its results mean nothing.

constexpr int REFINEMENTS = 2;  // factors without pivoting, or of a regularized matrix, have errors; no correction follows here

struct Job {
  long lanes, rows, data, columns, third, numbers;   // rows: of cotangents; 0: solutions are wanted;  third: of third rates
  const double *shared, *values;                     // [numbers][LANES], [block][data][LANES]
  const double *scales;                              // [columns][2], of third rates
  const double *x;                                   // [N_Q + 2 N_V][lanes]
  const double *row_mask, *diagonal_shift;           // [N], or null
  double *z;                                         // [N][columns][lanes], out; in where cotangents are wanted
  const double *z_bar;                               // [N][columns][rows][lanes]
  double *slopes, *x_slopes;                         // [block][rows][data][LANES], [block][rows][N_Q + 2 N_V][LANES], zeros
  const Mechanism *mechanism;
  const double *weights;                             // [block][N][LANES], one over the size of each unknown
};

static inline V take(const double* from, int valid) {
  V x = spread(from[0]);  // the first lane fills an incomplete block
  std::memcpy(&x, from, valid * sizeof(double));
  return x;
}

// Bytes of scratch memory.
extern "C" long start_scratch(const Mechanism* m, long numbers) {
  const Counts c(*m);
  return sizeof(V) * (2 * m->size + c.scratch + 5 * c.unknowns + c.entries + c.n_q + 2 * c.n_v + numbers);
}

extern "C" long start(const Job* job, long begin, long end, double* scratch) {
  const Job& J = *job;
  const long S = J.rows, L = J.lanes, C = J.columns;
  const Mechanism& m = *J.mechanism;
  const Counts c(m);
  const long N_ = c.unknowns, n_x = c.n_q + 2 * c.n_v;
  V* w = (V*)scratch;
  V *K = w + c.scratch, *exact = K + m.size, *b = exact + m.size, *goal = b + N_, *rest = goal + N_, *z = rest + N_;
  V *mu = z + N_, *entries = mu + N_, *x = entries + c.entries, *u = x + n_x;
  std::memcpy((void*)u, J.shared, J.numbers * sizeof(V));
  In in;
  point(in, m, c, w);
  in.R = b;
  in.z = z;
  in.x = x;
  in.u = u;
  in.mu = mu;
  in.entries = entries;
  // b becomes the solution.
  auto solved = [&]() {
    std::memcpy((void*)goal, b, N_ * sizeof(V));
    solve(m, N_, K, b);
    for (int k = 0; k < REFINEMENTS; k++) {
      std::memcpy((void*)rest, goal, N_ * sizeof(V));
      for (long e = 0; e < m.size; e++) rest[m.row[e]] -= exact[e] * b[m.column[e]];
      solve(m, N_, K, rest);
      for (long n = 0; n < N_; n++) b[n] += rest[n];
    }
  };
  for (long block = begin; block < end; block++) {
    const long at = block * LANES;
    const int valid = (int)(L - at < LANES ? L - at : LANES);
    point_data(in, (const V*)J.values + block * J.data);
    for (long n = 0; n < n_x; n++) x[n] = take(J.x + n * L + at, valid);
    if (!reliable(in, m, c, J.row_mask, J.diagonal_shift, spread(2.0), (const V*)J.weights + block * N_, K, b)) return 1;
    fill(in, m, nullptr, nullptr, exact);
    for (long k = 0; k < C; k++) {
      for (int i = 0; J.third && i < 2; i++) u[i] = spread(J.scales[2 * k + i]);
      if (!S) {
        J.third ? third_rates(in) : accelerations(in);
        solved();
        for (long n = 0; n < N_; n++) put(J.z + (n * C + k) * L + at, -b[n], valid);
        continue;
      }
      for (long n = 0; n < N_; n++) z[n] = take(J.z + (n * C + k) * L + at, valid);
      boundary(in);
      for (long s = 0; s < S; s++) {
        for (long n = 0; n < N_; n++) b[n] = take(J.z_bar + ((n * C + k) * S + s) * L + at, valid);
        solved();  // the matrix is symmetric
        for (long n = 0; n < N_; n++) mu[n] = -b[n];
        in.x_bar = (V*)J.x_slopes + (block * S + s) * n_x;
        point_data_bars(in, (V*)J.slopes + (block * S + s) * J.data);
        J.third ? pull_third_rates(in) : pull_accelerations(in);
      }
    }
  }
  return 0;
}
