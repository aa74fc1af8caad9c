/* The door through which IPOPT finds the fronts: the calling convention of HSL's MA57.

   IPOPT loads a library with these five functions at run time, where its option `hsllib` names one.
   What they do here is described in fronts.c; nothing of HSL is in it. Matrices are given by the
   entries (rows[k], columns[k]) of one triangle, from 1; repeats add up. The plan to use is the one
   last given to `hand_to_ipopt` in this thread; `keep` holds where each entry goes, `aside` where
   the plan is. Positive definite matrices only: of others it says that one eigenvalue is negative,
   and IPOPT adds to the diagonal.

   Gauss-Newton's matrices are positive semidefinite by their form, and one run's are alike. Where the
   plan says so, only the first is eliminated: its factors precondition conjugate gradients for the
   others (Hestenes, Stiefel 1952), which solve in a few steps, each as cheap as a solution. A matrix
   for which MOST steps are not ENOUGH is eliminated after all. */

#include <math.h>

static const integer MOST = 12;
static const double ENOUGH = 1e-9; /* left of the error, in the matrix's own norm */

typedef struct {
  const Fronts *fronts;
  integer poses, held;
  const integer *free, *anchors; /* nodes: of x, in its order, and those held */
  double *x;                     /* (6 nodes) */
  double *work;                  /* 4 times as much */
  integer alike;                 /* whether the matrices are semidefinite, and alike */
  integer factorised, own;       /* whether there are factors, and of the matrix given last */
  integer eliminations;
  integer entries;               /* of the matrix, in memory of IPOPT's: */
  const int *rows, *columns;
  const integer *goal;
  const double *values;
} Plan;

static _Thread_local Plan *handed;

/* The plan before, to be handed back. */
DECLARE Plan *hand_to_ipopt(Plan *plan) {
  Plan *before = handed;
  handed = plan;
  return before;
}

DECLARE void ma57id_(double *reals, int *integers) {
  memset(reals, 0, 5 * sizeof(double));
  memset(integers, 0, 20 * sizeof(int));
}

DECLARE void ma57ad_(int *n, int *entries, int *rows, int *columns, int *length, int *keep,
                     int *aside, int *control, int *info, double *reals) {
  Plan *plan = handed;
  memset(info, 0, 40 * sizeof(int));
  info[8] = info[9] = 1; /* lengths of work arrays: ours are elsewhere */
  if (!plan || *n != 6 * plan->poses) {
    info[0] = -1;
    return;
  }
  memcpy(aside, &plan, sizeof plan);
  plan->rows = rows, plan->columns = columns, plan->entries = *entries;
  integer *goal = (integer *)keep, a = -1, b = -1, at = 0, leading = 0; /* 2 entries ints at least */
  int turned = 0;
  for (integer k = 0; k < *entries; k++) {
    integer row = rows[k] - 1, column = columns[k] - 1;
    if (row / 6 != a || column / 6 != b) { /* neighbours mostly lie in the same block */
      a = row / 6, b = column / 6;
      at = block_of(plan->fronts, 6, plan->free[a], plan->free[b], &turned, &leading);
    }
    row %= 6, column %= 6;
    int other = a == b ? row < column : turned;
    goal[k] = at + (other ? row * leading + column : column * leading + row);
  }
}

/* Factors of the matrix given last. */
static void factorise(Plan *plan) {
  const Fronts *t = plan->fronts;
  clear(t, 6);
  for (integer k = 0; k < plan->entries; k++) t->panels[plan->goal[k]] += plan->values[k];
  for (integer k = 0; k < plan->held; k++) {
    int turned;
    integer leading, node = plan->anchors[k];
    integer at = block_of(t, 6, node, node, &turned, &leading);
    for (integer r = 0; r < 6; r++) t->panels[at + r * (leading + 1)] = 1.0;
  }
  plan->factorised = plan->own = !eliminate(t, 6, 0.0);
  plan->eliminations++;
  if (!plan->factorised) plan->alike = 0; /* semidefinite at best: IPOPT is to be told of each */
}

DECLARE void ma57bd_(int *n, int *entries, double *values, double *factor, int *lfactor,
                     int *ifactor, int *lifactor, int *length, int *keep, int *aside, int *control,
                     double *thresholds, int *info, double *reals) {
  Plan *plan;
  memcpy(&plan, aside, sizeof plan);
  memset(info, 0, 40 * sizeof(int));
  plan->values = values, plan->goal = (integer *)keep;
  plan->own = 0;
  if (!plan->alike || !plan->factorised) factorise(plan);
  info[23] = !plan->factorised; /* negative eigenvalues */
}

/* x with (the matrix of the factors) x = right. */
static void apply(const Plan *plan, const double *right, double *x) {
  memset(plan->x, 0, 6 * sizeof(double) * plan->fronts->nodes);
  for (integer p = 0; p < plan->poses; p++)
    memcpy(plan->x + 6 * plan->free[p], right + 6 * p, 6 * sizeof(double));
  solve(plan->fronts, 6, 1, plan->x);
  for (integer p = 0; p < plan->poses; p++)
    memcpy(x + 6 * p, plan->x + 6 * plan->free[p], 6 * sizeof(double));
}

/* y = (the matrix given last) x. */
static void multiply(const Plan *plan, const double *x, double *y) {
  memset(y, 0, 6 * sizeof(double) * plan->poses);
  for (integer k = 0; k < plan->entries; k++) {
    integer row = plan->rows[k] - 1, column = plan->columns[k] - 1;
    y[row] += plan->values[k] * x[column];
    if (row != column) y[column] += plan->values[k] * x[row];
  }
}

static double dot(integer n, const double *a, const double *b) {
  double sum = 0.0;
  for (integer i = 0; i < n; i++) sum += a[i] * b[i];
  return sum;
}

/* Conjugate gradients, in place; 0 where they do not get there: then `right` is as it was. */
static int descend(Plan *plan, double *right) {
  integer n = 6 * plan->poses;
  double *x = plan->work, *r = x + n, *z = r + n, *p = z + n, *ahead = plan->x;
  memset(x, 0, n * sizeof(double));
  memset(p, 0, n * sizeof(double));
  memcpy(r, right, n * sizeof(double));
  double before = 1.0, first = 0.0;
  for (integer k = 0; k < MOST; k++) {
    apply(plan, r, z);
    double left = dot(n, r, z);
    if (!k) first = left;
    if (left <= ENOUGH * ENOUGH * first) {
      memcpy(right, x, n * sizeof(double));
      return 1;
    }
    for (integer i = 0; i < n; i++) p[i] = z[i] + left / before * p[i];
    multiply(plan, p, ahead);
    double curvature = dot(n, p, ahead);
    if (!(curvature > 0.0)) return 0;
    for (integer i = 0; i < n; i++) {
      x[i] += left / curvature * p[i];
      r[i] -= left / curvature * ahead[i];
    }
    before = left;
  }
  return 0;
}

DECLARE void ma57cd_(int *job, int *n, double *factor, int *lfactor, int *ifactor, int *lifactor,
                     int *count, double *right, int *leading, double *work, int *lwork, int *aside,
                     int *control, int *info) {
  Plan *plan;
  memcpy(&plan, aside, sizeof plan);
  memset(info, 0, 40 * sizeof(int));
  for (integer k = 0; k < *count; k++, right += *leading) {
    if (plan->factorised && !plan->own) {
      if (descend(plan, right)) continue;
      factorise(plan);
    }
    if (plan->factorised)
      apply(plan, right, right);
    else /* never asked for, and never to be mistaken for a solution */
      for (integer i = 0; i < *n; i++) right[i] = NAN;
  }
}

/* To move the work arrays to larger ones: there is nothing in them. */
DECLARE void ma57ed_(int *n, int *what, int *keep, double *factor, int *lfactor, double *new_factor,
                     int *lnew, int *ifactor, int *lifactor, int *new_ifactor, int *linew,
                     int *info) {
  info[0] = 0;
}
