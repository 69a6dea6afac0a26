// Strengths of actions whose laws are called back (feedback.py): controllers, and laws that cannot be traced.
//
// Before this text stand factors.cpp and, generated, `signals`: s of these actions and then s'. A strength depends on the
// signals of the actions that its law reads: `pairs` of both. Slopes of a pair: by s, by s'.

enum { STRENGTHS, SLOPES, TANGENTS };  // what is asked for, each with those before it

// Of one block of lanes, [number][LANES] each.
struct Feedback {
  long (*call)(long what, long step, long block);  // makes the others of the signals; not 0: it raised
  V *signals, *strengths, *slopes, *tangents;      // [2 called], [called], [2][pairs], [n_b][called]: at constant signals
  V *strength_tangents;                            // [called], scratch
};

namespace {
// Where signals, strengths and slopes of a block are.
[[maybe_unused]] void point_feedback(In& in, const Feedback& f) {
  in.signals = f.signals;
  in.strengths = f.strengths;
  in.strength_tangents = f.strength_tangents;
  in.slopes = f.slopes;
}

// Asks for strengths at the values of `in`; not 0 where that raised.
[[maybe_unused]] long ask(const In& in, const Mechanism& m, const Feedback* f, long what, long step, long block) {
  if (!m.called) return 0;
  signals(in);
  return f->call(what, step, block);
}

// Strength tangents out of those of the signals, which stand in `signals`, and of the weights.
[[maybe_unused]] void strength_tangents(const In& in, const Mechanism& m, const Feedback* f, long column) {
  const V* ds = in.signals;
  V* df = f->strength_tangents;
  std::memcpy((void*)df, f->tangents + column * m.called, m.called * sizeof(V));
  for (long p = 0; p < m.pairs; p++)
    df[m.pair_to[p]] += in.slopes[p] * ds[m.pair_from[p]] + in.slopes[m.pairs + p] * ds[m.called + m.pair_from[p]];
}

// Cotangents of the signals [2 called] by those of the strengths.
[[maybe_unused]] void signal_bars(const In& in, const Mechanism& m, const V* strengths, V* signals) {
  std::memset((void*)signals, 0, 2 * m.called * sizeof(V));
  for (long p = 0; p < m.pairs; p++) {
    signals[m.pair_from[p]] += in.slopes[p] * strengths[m.pair_to[p]];
    signals[m.called + m.pair_from[p]] += in.slopes[m.pairs + p] * strengths[m.pair_to[p]];
  }
}
}  // namespace
