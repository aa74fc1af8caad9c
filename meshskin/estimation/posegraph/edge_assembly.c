/* Sums of the edge kernel over all edges of a graph; appended to the kernel that CasADi generated.

   RESIDUAL_gradient, _gauss_newton and _hessian are the functions of the kernel; DECLARE is the
   specifier of exported functions.

   edges (m, EDGE): the parameters of the kernel; scale (2): lengths of a unit increment, in m and
   rad. slots (m, 2): numbers in x of the poses of each edge; `free`, the number of poses in x, for
   an anchored pose.

   The Hessian is the upper triangle in compressed columns. Block column q has heights[q] blocks
   above its diagonal block; its nonzeros start at starts[q], and its column c holds column c of
   each of those blocks and then c + 1 entries of the diagonal block. above[e]: the block of edge e
   among those above the diagonal. */

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
    if (*blend == 0.0)
      RESIDUAL_gauss_newton(in, out, 0, 0, 0);
    else
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

/* out = the symmetric matrix with these nonzeros times x; rows: of the blocks above the diagonal. */
DECLARE void multiply_symmetric(long long free, const long long *starts, const long long *heights,
                                const long long *rows, const double *values, const double *x,
                                double *out) {
  for (long long k = 0; k < 6 * free; k++) out[k] = 0.0;
  for (long long q = 0; q < free; rows += heights[q++]) {
    const double *entry = values + starts[q];
    for (int c = 0; c < 6; c++) {
      const double here = x[6 * q + c];
      double total = 0.0;
      for (long long b = 0; b < heights[q]; b++, entry += 6) {
        const double *above = x + 6 * rows[b];
        double *there = out + 6 * rows[b];
        for (int r = 0; r < 6; r++) {
          total += entry[r] * above[r];
          there[r] += entry[r] * here;
        }
      }
      for (int r = 0; r < c; r++, entry++) {
        total += *entry * x[6 * q + r];
        out[6 * q + r] += *entry * here;
      }
      out[6 * q + c] += total + *entry++ * here;
    }
  }
}

/* Translation and quaternion (7 of every EDGE numbers) of T_i^-1 T_j, poses (n, 4, 4); without
   edges, of the poses themselves. */
DECLARE void displacements(long long m, const long long *edges, const double *poses, double *out) {
  static const double origin[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  for (long long e = 0; e < m; e++, out += EDGE) {
    const double *a = edges ? poses + 16 * edges[2 * e] : origin;
    const double *b = poses + 16 * (edges ? edges[2 * e + 1] : e);
    double r[3][3], *q = out + 3;
    for (int k = 0; k < 3; k++) {
      out[k] = 0.0;
      for (int l = 0; l < 3; l++) out[k] += a[4 * l + k] * (b[4 * l + 3] - a[4 * l + 3]);
      for (int c = 0; c < 3; c++)
        r[k][c] = a[k] * b[c] + a[4 + k] * b[4 + c] + a[8 + k] * b[8 + c];
    }
    /* The largest component comes first: it is at least 1/2, so that no digits cancel. */
    double squares[4] = {r[0][0] - r[1][1] - r[2][2], r[1][1] - r[0][0] - r[2][2],
                         r[2][2] - r[0][0] - r[1][1], r[0][0] + r[1][1] + r[2][2]};
    int i = 0;
    for (int k = 1; k < 4; k++)
      if (squares[k] > squares[i]) i = k;
    if (i == 3) {
      for (int k = 0; k < 3; k++) q[k] = r[(k + 2) % 3][(k + 1) % 3] - r[(k + 1) % 3][(k + 2) % 3];
    } else {
      int j = (i + 1) % 3, k = (i + 2) % 3;
      q[j] = r[i][j] + r[j][i], q[k] = r[i][k] + r[k][i], q[3] = r[k][j] - r[j][k];
    }
    q[i] = 1.0 + squares[i];
    double length = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    for (int k = 0; k < 4; k++) q[k] /= length;
  }
}
