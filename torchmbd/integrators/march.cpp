// Steps of generalized-alpha for eight lanes at a time: what March in generalized_alpha.py does, around generated code.
//
// Before this text stand factors.cpp and, generated, the sizes N_Q, BOUNDARY, ROOM and
//   residual, finish, boundary, residual_tangent, finish_tangent      (code.py)
// A block is eight lanes. Arrays of a block: state [slot][number], data [number], tangents of data [slot][number].
// If factors cannot be relied on, `march` returns 1 and has done nothing.

constexpr int N_X = N_Q + 3 * N_V + ROWS;
constexpr int MOST = 4;  // as in march.py

struct Job {
  long lanes, slots, data, data_tangents, uniform;                // numbers of each
  long first, steps, corrections, most, refresh, look, fresh;  // look: at factors and tangents; fresh: no factors yet
  long moving;                                                   // the last of the data, which change from step to step
  const double *given;                                           // [steps][uniform]
  double *state;                                                 // [block][1 + slots][N_X][8], in and out
  double *values, *tangents;                                     // [block][data][8], [block][slots][data_tangents][8]
  double *factors;                                               // [block][sizeof(Block)]
  const double *stay, *lost;                                     // [N], or null
  double *q, *v, *vd, *lam;                                      // records [steps][number][1 + slots][lanes]
  double *sizes, *errors;                                        // [steps][2][lanes], [3][slots][lanes]
  double *room;                                                  // scratch
  const double *moved;                                           // [steps][block][1 + slots][moving][8]
  const void *mechanism;                                         // of loops (native/)
  const double *passes;                                          // [block][8], corrections of tangents; `most` of all
};

extern "C" long march_room(const void*, long slots) {
  return (long)sizeof(Block) + (long)sizeof(V) * (ROOM + BOUNDARY + 3 * N + MATRIX + N * slots + N_X * (1 + slots) + 64);
}
extern "C" long march_factors(const void*) { return (long)sizeof(Block); }

// Unknowns (v', lam) that a step starts from: those of the state.
static void start(const V* x, V* z) {
  std::memcpy((void*)z, x + N_Q + N_V, N_V * sizeof(V));
  std::memcpy((void*)(z + N_V), x + N_Q + 3 * N_V, ROWS * sizeof(V));
}

// The data that move, as they are at the end of a step.
static void move(const Job& J, long step, long block) {
  if (!J.moving) return;
  const long blocks = (J.lanes + LANES - 1) / LANES, n = J.moving;
  const V* from = (const V*)J.moved + (step * blocks + block) * (1 + J.slots) * n;
  std::memcpy((void*)((V*)J.values + (block + 1) * J.data - n), from, n * sizeof(V));
  for (long s = 0; s < J.slots; s++)
    std::memcpy((void*)((V*)J.tangents + (block * J.slots + s + 1) * J.data_tangents - n), from + (s + 1) * n, n * sizeof(V));
}

extern "C" long march(const Job* job) {
  const Job& J = *job;
  const int S = (int)J.slots;
  V* w = (V*)J.room;
  Block& trial = *(Block*)(w + ROOM);
  V *b = (V*)(&trial + 1), *R = b + BOUNDARY, *z = R + N, *entries = z + N, *dz = entries + MATRIX, *next = dz + (long)N * S;
  if (J.fresh || J.look) {
    for (long block = 0; block * LANES < J.lanes; block++) {
      In in;
      move(J, 0, block);
      in.d = (const V*)J.values + block * J.data;
      in.x = (const V*)J.state + block * (1 + S) * N_X;
      in.u = J.given;
      in.z = z;
      start(in.x, z);
      if (!reliable(in, J.stay, J.lost, trial, w, entries)) return 1;
    }
  }
  for (long block = 0; block * LANES < J.lanes; block++) {
    const int valid = (int)(J.lanes - block * LANES < LANES ? J.lanes - block * LANES : LANES);
    V* state = (V*)J.state + block * (1 + S) * N_X;
    const V* tangents = (const V*)J.tangents + block * S * J.data_tangents;
    Block& factors = ((Block*)J.factors)[block];
    In in;
    in.d = (const V*)J.values + block * J.data;
    in.b = b;
    const V passes = ((const V*)J.passes)[block];
    bool fresh = J.fresh;
    for (long i = 0; i < J.steps; i++) {
      in.u = J.given + i * J.uniform;
      move(J, i, block);
      in.x = state;
      in.z = z;
      start(state, z);
      const bool always = J.refresh == 0, due = always || (J.first + i) % J.refresh == 0;
      const long renewed = J.corrections > 1 ? (J.corrections - 1 > 1 ? J.corrections - 1 : 1) : -1;
      if (fresh) renew(in, J.stay, J.lost, factors, w, entries);
      const bool begins = fresh;
      fresh = false;
      for (long k = 0; k < J.corrections; k++) {
        if (always || (due && k == renewed)) renew(in, J.stay, J.lost, factors, w, entries);
        residual(in, w, R);
        solve(factors.K, factors.inverse, R);
        for (int n = 0; n < N; n++) z[n] -= R[n];
        const long kept = k == J.corrections - 1 ? 1 : 0;
        if (kept || k == J.corrections - 2) put(J.sizes + (2 * i + kept) * J.lanes + block * LANES, largest(R, N_V), valid);
        if (kept && J.corrections == 1) put(J.sizes + 2 * i * J.lanes + block * LANES, largest(R, N_V), valid);
      }
      if (due && J.corrections == 1) renew(in, J.stay, J.lost, factors, w, entries);
      finish(in, w, next);
      if (S) boundary(in, w, b);
      for (int s = 0; s < S; s++) {
        V* ds = dz + (long)N * s;
        in.dx = state + (long)(1 + s) * N_X;
        in.dd = tangents + s * J.data_tangents;
        in.dz = ds;
        start(in.dx, ds);
        const bool looks = J.look && i == 0;
        for (long k = 0; k < J.most + looks + (begins ? MOST : 0); k++) {
          residual_tangent(in, w, R);
          solve(factors.K, factors.inverse, R);
          const V done = spread(k < J.most ? (double)k : -1.0), share = passes > done ? spread(1.0) : spread(0.0);
          for (int n = 0; n < N; n++) ds[n] -= share * R[n];
          if (!looks || k != J.most) continue;
          put(J.errors + s * J.lanes + block * LANES, largest(R, N_V), valid);
          put(J.errors + (S + s) * J.lanes + block * LANES, largest(ds, N_V), valid);
          put(J.errors + (2 * S + s) * J.lanes + block * LANES, largest(ds + N_V, ROWS), valid);
        }
        finish_tangent(in, w, next + (long)(1 + s) * N_X);
      }
      std::memcpy((void*)state, next, (1 + S) * N_X * sizeof(V));
      const long L = J.lanes, at = block * LANES;
      for (int s = 0; s <= S; s++) {
        const V* x = state + (long)s * N_X;
        for (long n = 0; n < N_Q; n++) put(J.q + ((i * N_Q + n) * (1 + S) + s) * L + at, x[n], valid);
        for (long n = 0; n < N_V; n++) {
          put(J.v + ((i * N_V + n) * (1 + S) + s) * L + at, x[N_Q + n], valid);
          put(J.vd + ((i * N_V + n) * (1 + S) + s) * L + at, x[N_Q + N_V + n], valid);
        }
        for (long n = 0; n < ROWS; n++) put(J.lam + ((i * ROWS + n) * (1 + S) + s) * L + at, x[N_Q + 3 * N_V + n], valid);
      }
    }
  }
  return 0;
}
