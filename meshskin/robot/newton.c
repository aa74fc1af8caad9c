/* Newton's method towards many poses: appended to the step that CasADi generated.

   JOINTS and TARGET are the lengths of its inputs; its outputs are the joints after the step and the
   residual before it. */

static double newton_step(double *q, const double *target, double *stepped) {
  double residual;
  const double *in[2] = {q, target};
  double *out[2] = {stepped, &residual};
  newton(in, out, 0, 0, 0);
  return residual;
}

/* Steps each row of `q` (count, JOINTS) towards its row of `targets` (count, TARGET), until its
   residual, which is kept in `residual` (count,), is less than `tolerance`, `iterations` times at most. */
EXPORT void iterate(int64_t count, double *q, const double *targets, int64_t iterations,
                   double tolerance, double *residual) {
  for (int64_t k = 0; k < count; k++) {
    double *row = q + JOINTS * k, stepped[JOINTS];
    residual[k] = INFINITY;
    for (int64_t k_iteration = 0; k_iteration < iterations; k_iteration++) {
      residual[k] = newton_step(row, targets + TARGET * k, stepped);
      if (!(residual[k] >= tolerance)) break;
      memcpy(row, stepped, sizeof stepped);
    }
  }
}

/* Steps `state` (JOINTS,) towards one row of `targets` (count, TARGET) after the other, `steps` times
   each; where it then is goes to the row of `q` (count, JOINTS). */
EXPORT void track(int64_t count, double *state, const double *targets, int64_t steps, double *q) {
  for (int64_t k = 0; k < count; k++) {
    double stepped[JOINTS];
    for (int64_t step = 0; step < steps; step++) {
      newton_step(state, targets + TARGET * k, stepped);
      memcpy(state, stepped, sizeof stepped);
    }
    memcpy(q + JOINTS * k, state, sizeof stepped);
  }
}
