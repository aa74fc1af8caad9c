/* IPOPT's linear solver: cholesky.c behind the calling convention of HSL's MA57.

   IPOPT loads a library with the five functions ma57id_, ma57ad_, ma57bd_, ma57cd_ and ma57ed_ at
   run time, where its option `hsllib` names one. No code of HSL is in this file. Matrices are given
   by the entries (rows[k], columns[k]) of one triangle, counted from 1; repeated entries add up. A
   solver works in the context that was last set in its thread by `set_context`; IPOPT's array
   `keep` holds the index in `panels` of each entry, its array `iwork` the pointer to the context.
   Matrices must be positive definite: of others the solver reports one negative eigenvalue, and
   IPOPT adds to the diagonal.

   The matrices of a Gauss-Newton run are positive semidefinite by construction, and differ little.
   Where the context says so (`similar`), only the first is factorized: its factors precondition
   conjugate gradients (Hestenes and Stiefel, 1952) for the others, which converge in a few
   iterations, each as cheap as a solve. A matrix for which MAX_ITERATIONS do not reach TOLERANCE is
   factorized after all. */

#include <math.h>

/* Most iterations of conjugate gradients: more cost as much as a factorization. */
static const integer MAX_ITERATIONS = 12;
/* Error of a solution relative to its size, both in the norm of the matrix: far below the tolerance
   of the gradient, which is sqrt(1e-9 / unknowns) (minimize.py). */
static const double TOLERANCE = 1e-9;

typedef struct {
  const Symbolic *symbolic;
  integer poses, anchored;
  const integer *free, *anchors; /* nodes of x, in its order, and anchored nodes */
  double *x;                     /* (6 nodes) */
  double *work;                  /* (4 * 6 nodes) */
  integer similar;               /* whether the matrices are semidefinite and differ little */
  integer factorized, current;   /* whether there are factors, and whether of the last matrix */
  integer factorizations;        /* how many were made */
  integer entries;               /* of the matrix, in memory of IPOPT: */
  const int *rows, *columns;
  const integer *target;         /* index in panels of each entry */
  const double *values;
} Context;

static _Thread_local Context *thread_context;

/* Set the context of this thread; returns the previous one, to be restored. */
DECLARE Context *set_context(Context *context) {
  Context *before = thread_context;
  thread_context = context;
  return before;
}

DECLARE void ma57id_(double *reals, int *integers) {
  memset(reals, 0, 5 * sizeof(double));
  memset(integers, 0, 20 * sizeof(int));
}

DECLARE void ma57ad_(int *n, int *entries, int *rows, int *columns, int *length, int *keep,
                     int *iwork, int *control, int *info, double *reals) {
  Context *context = thread_context;
  memset(info, 0, 40 * sizeof(int));
  info[8] = info[9] = 1; /* lengths of IPOPT's work arrays, which are not used */
  if (!context || *n != 6 * context->poses) {
    info[0] = -1;
    return;
  }
  memcpy(iwork, &context, sizeof context);
  context->rows = rows, context->columns = columns, context->entries = *entries;
  integer *target = (integer *)keep, a = -1, b = -1;
  integer at = 0, leading = 0; /* keep has 2 ints per entry */
  int transposed = 0;
  for (integer k = 0; k < *entries; k++) {
    integer row = rows[k] - 1, column = columns[k] - 1;
    if (row / 6 != a || column / 6 != b) { /* successive entries are mostly of one block */
      a = row / 6, b = column / 6;
      at = locate_block(context->symbolic, 6, context->free[a], context->free[b], &transposed,
                        &leading);
    }
    row %= 6, column %= 6;
    int other = a == b ? row < column : transposed;
    target[k] = at + (other ? row * leading + column : column * leading + row);
  }
}

/* Factorize the last matrix. */
static void factorize_matrix(Context *context) {
  const Symbolic *t = context->symbolic;
  clear_panels(t, 6);
  for (integer k = 0; k < context->entries; k++)
    t->panels[context->target[k]] += context->values[k];
  for (integer k = 0; k < context->anchored; k++) {
    int transposed;
    integer leading, node = context->anchors[k];
    integer at = locate_block(t, 6, node, node, &transposed, &leading);
    for (integer r = 0; r < 6; r++) t->panels[at + r * (leading + 1)] = 1.0;
  }
  context->factorized = context->current = !factorize(t, 6, 0.0);
  context->factorizations++;
  if (!context->factorized) context->similar = 0; /* from now on IPOPT is told of each matrix */
}

DECLARE void ma57bd_(int *n, int *entries, double *values, double *factor, int *lfactor,
                     int *ifactor, int *lifactor, int *length, int *keep, int *iwork, int *control,
                     double *thresholds, int *info, double *reals) {
  Context *context;
  memcpy(&context, iwork, sizeof context);
  memset(info, 0, 40 * sizeof(int));
  context->values = values, context->target = (integer *)keep;
  context->current = 0;
  if (!context->similar || !context->factorized) factorize_matrix(context);
  info[23] = !context->factorized; /* negative eigenvalues */
}

/* x with (the matrix of the factors) x = right. */
static void apply(const Context *context, const double *right, double *x) {
  memset(context->x, 0, 6 * sizeof(double) * context->symbolic->nodes);
  for (integer p = 0; p < context->poses; p++)
    memcpy(context->x + 6 * context->free[p], right + 6 * p, 6 * sizeof(double));
  solve(context->symbolic, 6, 1, context->x);
  for (integer p = 0; p < context->poses; p++)
    memcpy(x + 6 * p, context->x + 6 * context->free[p], 6 * sizeof(double));
}

/* y = (the last matrix) x. */
static void multiply(const Context *context, const double *x, double *y) {
  memset(y, 0, 6 * sizeof(double) * context->poses);
  for (integer k = 0; k < context->entries; k++) {
    integer row = context->rows[k] - 1, column = context->columns[k] - 1;
    y[row] += context->values[k] * x[column];
    if (row != column) y[column] += context->values[k] * x[row];
  }
}

static double dot(integer n, const double *a, const double *b) {
  double sum = 0.0;
  for (integer i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* Conjugate gradients, in place; returns 0 and leaves `right` unchanged if not converged. */
static int conjugate_gradients(Context *context, double *right) {
  integer n = 6 * context->poses;
  double *x = context->work, *r = x + n, *z = r + n, *p = z + n, *ap = context->x;
  memset(x, 0, n * sizeof(double));
  memset(p, 0, n * sizeof(double));
  memcpy(r, right, n * sizeof(double));
  double rz_before = 1.0, first = 0.0;
  for (integer k = 0; k < MAX_ITERATIONS; k++) {
    apply(context, r, z);
    double rz = dot(n, r, z);
    if (!k) first = rz;
    if (rz <= TOLERANCE * TOLERANCE * first) {
      memcpy(right, x, n * sizeof(double));
      return 1;
    }
    for (integer i = 0; i < n; i++) p[i] = z[i] + rz / rz_before * p[i];
    multiply(context, p, ap);
    double curvature = dot(n, p, ap);
    if (!(curvature > 0.0)) return 0;
    for (integer i = 0; i < n; i++) {
      x[i] += rz / curvature * p[i];
      r[i] -= rz / curvature * ap[i];
    }
    rz_before = rz;
  }
  return 0;
}

DECLARE void ma57cd_(int *job, int *n, double *factor, int *lfactor, int *ifactor, int *lifactor,
                     int *count, double *right, int *leading, double *work, int *lwork, int *iwork,
                     int *control, int *info) {
  Context *context;
  memcpy(&context, iwork, sizeof context);
  memset(info, 0, 40 * sizeof(int));
  for (integer k = 0; k < *count; k++, right += *leading) {
    if (context->factorized && !context->current) {
      if (conjugate_gradients(context, right)) continue;
      factorize_matrix(context);
    }
    if (context->factorized)
      apply(context, right, right);
    else /* IPOPT does not ask; never to be mistaken for a solution */
      for (integer i = 0; i < *n; i++) right[i] = NAN;
  }
}

/* Move the work arrays to larger ones: nothing is in them. */
DECLARE void ma57ed_(int *n, int *what, int *keep, double *factor, int *lfactor, double *new_factor,
                     int *lnew, int *ifactor, int *lifactor, int *new_ifactor, int *linew,
                     int *info) {
  info[0] = 0;
}
