/* The edge kernel over all edges of a graph, summed: appended to the kernel that CasADi generated.

   RESIDUAL_gradient and RESIDUAL_hessian are the kernel's functions; DECLARE is what must be in
   front of a function that is called from outside.

   edges (m, EDGE): the kernel's numbers; scale (2): lengths of a unit increment, in m and rad.
   slots (m, 2): which pose of x an edge's ends are; `free`, the number of poses in x, where held.
   The Hessian is the upper triangle in compressed columns. Block column q has heights[q] blocks
   above its diagonal block; its nonzeros start at starts[q], and its column c holds the column c of
   each of those blocks and then c + 1 entries of the diagonal block. above[e]: which of those
   blocks is edge e's. */

static void gather(const long long *slots, long long free, const double *x, double *local) {
  for (int end = 0; end < 2; end++)
    for (int k = 0; k < 6; k++)
      local[6 * end + k] = slots[end] < free ? x[6 * slots[end] + k] : 0.0;
}

DECLARE double sum_gradient(long long m, long long free, const long long *slots,
                            const double *edges, const double *scale, const double *x,
                            double *gradient) {
  double total = 0.0, value, local[12], own[12];
  for (long long k = 0; k < 6 * free; k++) gradient[k] = 0.0;
  for (long long e = 0; e < m; e++) {
    const double *in[3] = {local, edges + EDGE * e, scale};
    double *out[2] = {&value, own};
    gather(slots + 2 * e, free, x, local);
    RESIDUAL_gradient(in, out, 0, 0, 0);
    total += value;
    for (int end = 0; end < 2; end++)
      if (slots[2 * e + end] < free)
        for (int k = 0; k < 6; k++) gradient[6 * slots[2 * e + end] + k] += own[6 * end + k];
  }
  return total;
}

DECLARE void sum_hessian(long long m, long long free, const long long *slots,
                         const double *edges, const double *scale, const double *x,
                         const double *blend, const long long *starts, const long long *heights,
                         const long long *above, long long size, double *values) {
  double local[12], ends[2][21], between[36];
  for (long long k = 0; k < size; k++) values[k] = 0.0;
  for (long long e = 0; e < m; e++) {
    const double *in[4] = {local, edges + EDGE * e, scale, blend};
    double *out[3] = {ends[0], ends[1], between};
    long long i = slots[2 * e], j = slots[2 * e + 1];
    gather(slots + 2 * e, free, x, local);
    RESIDUAL_hessian(in, out, 0, 0, 0);
    for (int end = 0; end < 2; end++) {
      long long q = slots[2 * e + end];
      if (q == free) continue;
      const double *entry = ends[end];
      double *column = values + starts[q] + 6 * heights[q];
      for (int c = 0; c < 6; column += 6 * heights[q] + ++c)
        for (int r = 0; r <= c; r++) column[r] += *entry++;
    }
    if (i == free || j == free) continue;
    long long q = i < j ? j : i;
    double *column = values + starts[q] + 6 * above[e];
    for (int c = 0; c < 6; column += 6 * heights[q] + ++c)
      for (int r = 0; r < 6; r++) column[r] += i < j ? between[6 * r + c] : between[6 * c + r];
  }
}
