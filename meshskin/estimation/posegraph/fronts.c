/* Multifrontal Cholesky factorisation of sparse symmetric matrices of small square blocks.

   A front is a dense matrix over a few nodes: its pivots, which are eliminated in it, and the later
   nodes that they touch. Of its lower triangle the pivots' columns are kept, the "panel"; the rest,
   the "update", waits on a stack until the parent takes it up. Updates of even and odd depth have a
   stack each: so a front's own never lies on top of its children's.
   BLAS and LAPACK are those of SciPy; `use` hands them over. Dense matrices are column by column. */

#include <string.h>

typedef long long integer;

typedef struct {
  integer nodes, fronts;
  const integer *order, *place;     /* node at a place in the order of elimination, and back */
  const integer *front;             /* (nodes) the front that eliminates what is at a place */
  const integer *start, *rows;      /* places of front f: rows[start[f]] ... rows[start[f + 1] - 1] */
  const integer *up;                /* of each row but the pivots: which row of the parent it is */
  const integer *pivots, *parent;   /* the first rows are pivots, consecutive places */
  const integer *depth, *span;      /* fronts of the subtree: the children of f are f - 1, then what
                                       is left of its subtree, and so on */
  const integer *panel;             /* where the panel starts, in blocks */
  double *panels, *stacks[2], *work; /* work: the largest panel, and a number a row of x */
} Fronts;

static void (*dpotrf)(const char *, int *, double *, int *, int *);
static void (*dpotri)(const char *, int *, double *, int *, int *);
static void (*dtrsm)(const char *, const char *, const char *, const char *, int *, int *,
                     const double *, double *, int *, double *, int *);
static void (*dsyrk)(const char *, const char *, int *, int *, const double *, double *, int *,
                     const double *, double *, int *);
static void (*dsymm)(const char *, const char *, int *, int *, const double *, double *, int *,
                     double *, int *, const double *, double *, int *);
static void (*dgemm)(const char *, const char *, int *, int *, int *, const double *, double *,
                     int *, double *, int *, const double *, double *, int *);
static void (*dtrsv)(const char *, const char *, const char *, int *, double *, int *, double *,
                     int *);
static void (*dgemv)(const char *, int *, int *, const double *, double *, int *, double *, int *,
                     const double *, double *, int *);

static const double one = 1.0, minus = -1.0, zero = 0.0;

/* The functions above, in that order. */
DECLARE void use(void **functions) {
  void *places[] = {&dpotrf, &dpotri, &dtrsm, &dsyrk, &dsymm, &dgemm, &dtrsv, &dgemv};
  for (int k = 0; k < 8; k++) memcpy(places[k], functions + k, sizeof(void *));
}

static integer size_of(const Fronts *t, integer f) { return t->start[f + 1] - t->start[f]; }

static integer update_size(const Fronts *t, integer size, integer f) {
  integer count = size * (size_of(t, f) - t->pivots[f]);
  return count * count;
}

/* Which row of front f a place is: it is one of them. */
static integer row_of(const Fronts *t, integer f, integer place) {
  const integer *rows = t->rows + t->start[f];
  integer low = 0, high = size_of(t, f) - 1;
  if (place - rows[0] < t->pivots[f]) return place - rows[0];
  while (low < high) {
    integer middle = (low + high) / 2;
    if (rows[middle] < place)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

/* Where entry (0, 0) of the block of nodes `a` and `b` is among the panels; *turned: it is kept
   transposed; *leading: from column to column. */
static integer block_of(const Fronts *t, integer size, integer a, integer b, int *turned,
                        integer *leading) {
  integer row = t->place[a], column = t->place[b];
  *turned = row < column;
  if (*turned) row = t->place[b], column = t->place[a];
  integer f = t->front[column];
  *leading = size * size_of(t, f);
  return size * size * t->panel[f] + size * (column - t->rows[t->start[f]]) * *leading +
         size * row_of(t, f, row);
}

DECLARE void clear(const Fronts *t, integer size) {
  memset(t->panels, 0, sizeof(double) * size * size * t->panel[t->fronts]);
}

/* Add `count` blocks, row by row, between nodes rows[k] and columns[k], each pair given one way
   round; of diagonal blocks the lower triangle counts. */
DECLARE void add(const Fronts *t, integer size, integer count, const integer *rows,
                 const integer *columns, const double *blocks) {
  for (integer k = 0; k < count; k++, blocks += size * size) {
    int turned;
    integer leading, at = block_of(t, size, rows[k], columns[k], &turned, &leading);
    for (integer r = 0; r < size; r++)
      for (integer c = 0; c < (rows[k] == columns[k] ? r + 1 : size); c++)
        t->panels[at + (turned ? r * leading + c : c * leading + r)] += blocks[size * r + c];
  }
}

/* Lower triangle of child c's update, added to its parent's panel and update. */
static void take_up(const Fronts *t, integer size, integer c, const double *update, double *panel,
                    double *own) {
  integer f = t->parent[c], pivots = t->pivots[f];
  integer height = size * size_of(t, f), rest = height - size * pivots;
  integer count = size_of(t, c) - t->pivots[c];
  const integer *up = t->up + t->start[c] + t->pivots[c];
  for (integer j = 0; j < count; j++) {
    double *target = up[j] < pivots ? panel + size * up[j] * height
                                    : own + size * (up[j] - pivots) * rest - size * pivots;
    integer leading = up[j] < pivots ? height : rest;
    for (integer k = 0; k < size; k++, target += leading, update += size * count) {
      const double *from = update + size * j;
      for (integer i = j, next; i < count; i = next) {
        for (next = i + 1; next < count && up[next] == up[next - 1] + 1;) next++;
        double *to = target + size * up[i];
        for (integer r = i == j ? k : 0; r < size * (next - i); r++) to[r] += from[r];
        from += size * (next - i);
      }
    }
  }
}

/* Eliminate, bottom up, what is in the panels. 0, or 1 + the node whose pivot is not above `least`
   as a share of its diagonal entry: then the matrix is not positive definite, up to rounding. */
DECLARE integer eliminate(const Fronts *t, integer size, double least) {
  double *tops[2] = {t->stacks[0], t->stacks[1]}, *scale = t->work;
  for (integer f = 0; f < t->fronts; f++) {
    integer odd = t->depth[f] % 2, rest_nodes = size_of(t, f) - t->pivots[f];
    int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width, fault;
    double *panel = t->panels + size * size * t->panel[f], *own = tops[odd], *below = tops[!odd];
    for (int k = 0; k < width; k++) scale[k] = panel[k * (integer)(height + 1)];
    int any = t->span[f] > 1;
    if (any) memset(own, 0, sizeof(double) * rest * rest);
    for (integer c = f - 1; c > f - t->span[f]; c -= t->span[c]) { /* the last lies on top */
      below -= update_size(t, size, c);
      take_up(t, size, c, below, panel, own);
    }
    tops[!odd] = below;
    dpotrf("L", &width, panel, &height, &fault);
    for (int k = 0; k < width; k++) {
      double root = panel[k * (integer)(height + 1)];
      if (fault == k + 1 || !(root * root > least * scale[k]))
        return 1 + t->order[t->rows[t->start[f]] + k / size];
    }
    if (!rest) continue;
    dtrsm("R", "L", "T", "N", &rest, &width, &one, panel, &height, panel + width, &height);
    dsyrk("L", "N", &rest, &width, &minus, panel + width, &height, any ? &one : &zero, own, &rest);
    tops[odd] = own + size * size * rest_nodes * rest_nodes;
  }
  return 0;
}

/* Solve for `count` right sides x, node by node, each in turn; in place. */
DECLARE void solve(const Fronts *t, integer size, integer count, double *x) {
  int unit = 1;
  double *y = t->work;
  for (integer k = 0; k < count; k++, x += size * t->nodes) {
    double *aside = y + size * t->nodes;
    for (integer p = 0; p < t->nodes; p++)
      memcpy(y + size * p, x + size * t->order[p], sizeof(double) * size);
    for (integer f = 0; f < t->fronts; f++) {
      const integer *rows = t->rows + t->start[f];
      int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width;
      double *panel = t->panels + size * size * t->panel[f], *own = y + size * rows[0];
      dtrsv("L", "N", "N", &width, panel, &height, own, &unit);
      if (!rest) continue;
      dgemv("N", &rest, &width, &one, panel + width, &height, own, &unit, &zero, aside, &unit);
      for (integer i = t->pivots[f], from = 0; i < size_of(t, f); i++)
        for (integer r = 0; r < size; r++) y[size * rows[i] + r] -= aside[from++];
    }
    for (integer f = t->fronts - 1; f >= 0; f--) {
      const integer *rows = t->rows + t->start[f];
      int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width;
      double *panel = t->panels + size * size * t->panel[f], *own = y + size * rows[0];
      for (integer i = t->pivots[f], to = 0; i < size_of(t, f); i++)
        for (integer r = 0; r < size; r++) aside[to++] = y[size * rows[i] + r];
      if (rest)
        dgemv("T", &rest, &width, &minus, panel + width, &height, aside, &unit, &one, own, &unit);
      dtrsv("L", "T", "N", &width, panel, &height, own, &unit);
    }
    for (integer p = 0; p < t->nodes; p++)
      memcpy(x + size * t->order[p], y + size * p, sizeof(double) * size);
  }
}

/* Lower triangle of the part of the inverse that child c needs, from that of its parent's front:
   `near`, the pivots' columns, and `far`, the rest. */
static void hand_down(const Fronts *t, integer size, integer c, const double *near,
                      const double *far, double *part) {
  integer f = t->parent[c], pivots = t->pivots[f];
  integer height = size * size_of(t, f), rest = height - size * pivots;
  integer count = size_of(t, c) - t->pivots[c];
  const integer *up = t->up + t->start[c] + t->pivots[c];
  for (integer j = 0; j < count; j++) {
    const double *source = up[j] < pivots ? near + size * up[j] * height
                                          : far + size * (up[j] - pivots) * rest - size * pivots;
    integer leading = up[j] < pivots ? height : rest;
    for (integer k = 0; k < size; k++, source += leading, part += size * count) {
      double *to = part + size * j;
      for (integer i = j, next; i < count; i = next) {
        for (next = i + 1; next < count && up[next] == up[next - 1] + 1;) next++;
        memcpy(to, source + size * up[i], sizeof(double) * size * (next - i));
        to += size * (next - i);
      }
    }
  }
}

/* Diagonal blocks (nodes, size, size) of the inverse, top down. The panels are used up. */
DECLARE void invert(const Fronts *t, integer size, double *blocks) {
  double *tops[2] = {t->stacks[0], t->stacks[1]}, *near = t->work;
  for (integer f = t->fronts - 1; f >= 0; f--) {
    integer odd = t->depth[f] % 2, start = t->rows[t->start[f]];
    int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width, fault;
    double *panel = t->panels + size * size * t->panel[f], *far = tops[odd] - rest * (integer)rest;
    if (rest) {
      dtrsm("R", "L", "N", "N", &rest, &width, &one, panel, &height, panel + width, &height);
      dsymm("L", "L", &rest, &width, &minus, far, &rest, panel + width, &height, &zero,
            near + width, &height);
    }
    dpotri("L", &width, panel, &height, &fault);
    for (integer j = 0; j < width; j++)
      for (integer i = 0; i < width; i++)
        near[i + j * height] = panel[i > j ? i + j * height : j + i * height];
    if (rest)
      dgemm("T", "N", &width, &width, &rest, &minus, panel + width, &height, near + width, &height,
            &one, near, &height);
    for (integer p = 0; p < t->pivots[f]; p++) {
      const double *corner = near + size * p * (height + 1);
      double *block = blocks + size * size * t->order[start + p];
      for (integer i = 0; i < size; i++)
        for (integer j = 0; j <= i; j++)
          block[size * i + j] = block[size * j + i] = corner[i + j * height];
    }
    for (integer c = f - 1; c > f - t->span[f]; c -= t->span[c]) tops[!odd] += update_size(t, size, c);
    double *top = tops[!odd]; /* the last child is the next: it is to lie on top */
    for (integer c = f - 1; c > f - t->span[f]; c -= t->span[c])
      hand_down(t, size, c, near, far, top -= update_size(t, size, c));
    tops[odd] = far;
  }
}
