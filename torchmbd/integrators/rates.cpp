// The index-1 right-hand side for eight lanes at a time: what Dynamics.rates does, around generated code.
//
// Before this text stand factors.cpp and, generated, the sizes N_Q, BOUNDARY, ROOM and
//   residual, kinematics, boundary, residual_tangent, kinematics_tangent      (code.py)

struct Job {
  long lanes, slots, data, data_tangents, check;  // check: whether the factors can be relied on, or return 1
  const double *uniform, *values, *tangents;  // [], [block][data][8], [block][slots][data_tangents][8]
  const double *y;                            // [N_Q + N_V][1 + slots][lanes]
  double *dy, *lam;                           // the same; [ROWS][1 + slots][lanes]
  double *room;
  const void *mechanism;                      // of loops (native/)
};

extern "C" long rates_room(const void*) { return (long)(sizeof(Block) + sizeof(V) * (ROOM + BOUNDARY + 2 * N + MATRIX + 4 * (N_Q + N_V))); }

extern "C" long rates(const Job* job) {
  const Job& J = *job;
  const long S = J.slots, L = J.lanes;
  Block& factors = *(Block*)J.room;
  V *w = (V*)(&factors + 1), *b = w + ROOM, *R = b + BOUNDARY, *z = R + N, *entries = z + N, *x = entries + MATRIX;
  V *dx = x + N_Q + N_V, *out = dx + N_Q + N_V;
  for (long block = 0; block * LANES < L; block++) {
    const long at = block * LANES;
    const int valid = (int)(L - at < LANES ? L - at : LANES);
    In in;
    in.u = J.uniform;
    in.d = (const V*)J.values + block * J.data;
    in.x = x;
    in.z = z;
    in.b = b;
    auto take = [&](V* to, long slot) {
      for (long n = 0; n < N_Q + N_V; n++) {
        const double* from = J.y + (n * (1 + S) + slot) * L + at;
        to[n] = spread(from[0]);  // the first lane fills an incomplete block
        std::memcpy((void*)(to + n), from, valid * sizeof(double));
      }
    };
    auto give = [&](const V* a, long slot) {  // a holds minus (accelerations, multipliers)
      for (long n = 0; n < N_Q; n++) put(J.dy + (n * (1 + S) + slot) * L + at, out[n], valid);
      for (long n = 0; n < N_V; n++) put(J.dy + ((N_Q + n) * (1 + S) + slot) * L + at, -a[n], valid);
      for (long n = 0; n < ROWS; n++) put(J.lam + (n * (1 + S) + slot) * L + at, -a[N_V + n], valid);
    };
    take(x, 0);
    if (J.check) {
      if (!reliable(in, nullptr, nullptr, factors, w, entries)) return 1;
    } else {
      renew(in, nullptr, nullptr, factors, w, entries);
    }
    residual(in, w, R);
    solve(factors.K, factors.inverse, R);
    for (int n = 0; n < N; n++) z[n] = -R[n];
    kinematics(in, w, out);
    give(R, 0);
    if (S) boundary(in, w, b);
    for (long s = 0; s < S; s++) {
      take(dx, 1 + s);
      in.dx = dx;
      in.dd = (const V*)J.tangents + (block * S + s) * J.data_tangents;
      residual_tangent(in, w, R);
      solve(factors.K, factors.inverse, R);
      kinematics_tangent(in, w, out);
      give(R, 1 + s);
    }
  }
  return 0;
}
