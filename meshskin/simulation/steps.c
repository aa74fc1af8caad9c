/* Steps of the closed loop over many states: appended to the step that CasADi generated.

   STATE, REFERENCE, PATCH, MAP, PARAMETERS and OUTPUT are the lengths of the step's inputs and of its
   second output; FORCE is where the output has the force. */

enum { AHEAD = 16 };  /* steps, some 10 us: longer than a read from memory takes */

/* Prefetch a patch before its face is reached: the patches of a fine mesh do not fit the caches. */
static void prefetch(const double *patch) {
#if defined(__GNUC__)
  for (int i = 0; i < PATCH; i += 8) __builtin_prefetch(patch + i);
  __builtin_prefetch(patch + PATCH - 1);
#else
  (void)patch;
#endif
}

/* Step k maps row k of `before` (count, STATE), `references`, `maps` and `parameters` (`stride`
   apart, 0: the same for all) and the patch of face faces[k] to row k of `after` and `outputs`. If
   `after` is `before` one row further on, the steps follow each other.

   Ends after a step whose foot point, the last two numbers of the state, lies further than `margin`
   outside its face, or is not a number; and, if `until_touch`, after the first step in contact.
   Returns the number of steps done. */
EXPORT int64_t steps(int64_t count, const double *before, double *after, const double *references,
                     const double *patches, const int64_t *faces, const double *maps,
                     const double *parameters, int64_t stride, double *outputs, double margin,
                     int64_t until_touch) {
  for (int64_t k = 0; k < count; k++) {
    double state[STATE], next[STATE], output[OUTPUT];  /* local: nothing aliases them */
    const double *in[5] = {state, references + REFERENCE * k, patches + PATCH * faces[k],
                           maps + MAP * k, parameters + stride * k};
    double *out[2] = {next, output};
    if (k + AHEAD < count && faces[k + AHEAD] != faces[k + AHEAD - 1])
      prefetch(patches + PATCH * faces[k + AHEAD]);
    memcpy(state, before + STATE * k, sizeof state);
    step(in, out, 0, 0, 0);
    memcpy(after + STATE * k, next, sizeof next);
    memcpy(outputs + OUTPUT * k, output, sizeof output);
    double u = next[STATE - 2], v = next[STATE - 1];
    if (!(u >= -margin && v >= -margin && u + v <= 1.0 + margin)) return k + 1;
    if (until_touch && output[FORCE] > 0.0) return k + 1;
  }
  return count;
}
