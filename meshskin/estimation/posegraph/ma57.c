/* The door through which IPOPT finds the fronts: the calling convention of HSL's MA57.

   IPOPT loads a library with these five functions at run time, where its option `hsllib` names one.
   What they do here is described in fronts.c; nothing of HSL is in it. Matrices are given by the
   entries (rows[k], columns[k]) of one triangle, from 1; repeats add up. The plan to use is the one
   last given to `hand_to_ipopt` in this thread; `keep` holds where each entry goes, `aside` where
   the plan is. Positive definite matrices only: of others it says that one eigenvalue is negative,
   and IPOPT adds to the diagonal. */

#include <math.h>

typedef struct {
  const Fronts *fronts;
  integer poses, held;
  const integer *free, *anchors; /* nodes: of x, in its order, and those held */
  double *x;                     /* (6 nodes) */
  integer factorised;
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

DECLARE void ma57bd_(int *n, int *entries, double *values, double *factor, int *lfactor,
                     int *ifactor, int *lifactor, int *length, int *keep, int *aside, int *control,
                     double *thresholds, int *info, double *reals) {
  Plan *plan;
  memcpy(&plan, aside, sizeof plan);
  memset(info, 0, 40 * sizeof(int));
  const Fronts *t = plan->fronts;
  const integer *goal = (integer *)keep;
  clear(t, 6);
  for (integer k = 0; k < *entries; k++) t->panels[goal[k]] += values[k];
  for (integer k = 0; k < plan->held; k++) {
    int turned;
    integer leading, node = plan->anchors[k];
    integer at = block_of(t, 6, node, node, &turned, &leading);
    for (integer r = 0; r < 6; r++) t->panels[at + r * (leading + 1)] = 1.0;
  }
  plan->factorised = !eliminate(t, 6, 0.0);
  info[23] = !plan->factorised; /* negative eigenvalues */
}

DECLARE void ma57cd_(int *job, int *n, double *factor, int *lfactor, int *ifactor, int *lifactor,
                     int *count, double *right, int *leading, double *work, int *lwork, int *aside,
                     int *control, int *info) {
  Plan *plan;
  memcpy(&plan, aside, sizeof plan);
  memset(info, 0, 40 * sizeof(int));
  for (integer k = 0; k < *count; k++, right += *leading) {
    if (!plan->factorised) { /* never asked for, and never to be mistaken for a solution */
      for (integer i = 0; i < *n; i++) right[i] = NAN;
      continue;
    }
    memset(plan->x, 0, 6 * sizeof(double) * plan->fronts->nodes);
    for (integer p = 0; p < plan->poses; p++)
      memcpy(plan->x + 6 * plan->free[p], right + 6 * p, 6 * sizeof(double));
    solve(plan->fronts, 6, 1, plan->x);
    for (integer p = 0; p < plan->poses; p++)
      memcpy(right + 6 * p, plan->x + 6 * plan->free[p], 6 * sizeof(double));
  }
}

/* To move the work arrays to larger ones: there is nothing in them. */
DECLARE void ma57ed_(int *n, int *what, int *keep, double *factor, int *lfactor, double *new_factor,
                     int *lnew, int *ifactor, int *lifactor, int *new_ifactor, int *linew,
                     int *info) {
  info[0] = 0;
}
