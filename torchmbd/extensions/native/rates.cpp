// The index-1 right-hand side for LANES lanes at a time: what Dynamics.rates does, around generated code.
//
// Before this text stand factors.cpp, feedback.cpp and, generated,
//   signals, residual, kinematics, matrix, boundary, signal_tangents, residual_tangent, kinematics_tangent      (functions.py)

struct Job {
  long lanes, n_b, data, data_tangents, check;  // check: whether the factors can be relied on, or return 1
  const double *prescribed, *values, *tangents;  // [][LANES], [block][data][LANES], [block][n_b][data_tangents][LANES]
  const double *y;                            // [N_Q + N_V][1 + n_b][lanes]
  double *dy, *lam;                           // the same; [ROWS][1 + n_b][lanes]
  double *scratch;
  const Mechanism *mechanism;
  const Feedback *feedback;                   // or null
  const double *weights;                      // [block][N][LANES], one over the size of each unknown
};

// Bytes of scratch memory.
extern "C" long rates_scratch(const Mechanism* m) {
  const Counts c(*m);
  return sizeof(V) * (m->size + c.scratch + c.entries + 2 * c.unknowns + 3 * (c.n_q + c.n_v));
}

extern "C" long rates(const Job* job) {
  const Job& J = *job;
  const long S = J.n_b, L = J.lanes;
  const Mechanism& m = *J.mechanism;
  const Counts c(m);
  const long n_z = c.n_q + c.n_v;
  V* w = (V*)J.scratch;
  V *K = w + c.scratch, *R = K + m.size, *z = R + c.unknowns, *entries = z + c.unknowns, *x = entries + c.entries;
  V *dx = x + n_z, *out = dx + n_z;
  In in;
  point(in, m, c, w);
  in.R = R;
  in.z = z;
  in.x = x;
  in.dx = dx;
  in.next = out;
  in.entries = entries;
  in.u = (const V*)J.prescribed;
  if (m.called) point_feedback(in, *J.feedback);
  for (long block = 0; block * LANES < L; block++) {
    const long at = block * LANES;
    const int valid = (int)(L - at < LANES ? L - at : LANES);
    point_data(in, (const V*)J.values + block * J.data);
    auto take = [&](V* to, long column) {
      for (long n = 0; n < n_z; n++) {
        const double* from = J.y + (n * (1 + S) + column) * L + at;
        to[n] = spread(from[0]);  // the first lane fills an incomplete block
        std::memcpy((void*)(to + n), from, valid * sizeof(double));
      }
    };
    auto give = [&](const V* a, long column) {  // a holds minus (accelerations, multipliers)
      for (long n = 0; n < c.n_q; n++) put(J.dy + (n * (1 + S) + column) * L + at, out[n], valid);
      for (long n = 0; n < c.n_v; n++) put(J.dy + ((c.n_q + n) * (1 + S) + column) * L + at, -a[n], valid);
      for (long n = 0; n < c.rows; n++) put(J.lam + (n * (1 + S) + column) * L + at, -a[c.n_v + n], valid);
    };
    take(x, 0);
    if (J.check) {
      if (!reliable(in, m, c, nullptr, nullptr, spread(2.0), (const V*)J.weights + block * c.unknowns, K, R)) return 1;
    } else {
      renew(in, m, c.unknowns, nullptr, nullptr, K);
    }
    if (ask(in, m, J.feedback, S ? TANGENTS : STRENGTHS, 0, block)) return 2;
    residual(in);
    solve(m, c.unknowns, K, R);
    for (long n = 0; n < c.unknowns; n++) z[n] = -R[n];
    kinematics(in);
    give(R, 0);
    if (S) boundary(in);
    for (long s = 0; s < S; s++) {
      take(dx, 1 + s);
      point_data_tangents(in, (const V*)J.tangents + (block * S + s) * J.data_tangents);
      if (m.called) {
        signal_tangents(in);
        strength_tangents(in, m, J.feedback, s);
      }
      residual_tangent(in);
      solve(m, c.unknowns, K, R);
      kinematics_tangent(in);
      give(R, 1 + s);
    }
  }
  return 0;
}
