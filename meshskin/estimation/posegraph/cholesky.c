/* Multifrontal Cholesky factorization of sparse symmetric matrices of small square blocks.

   A front is a dense matrix over a few nodes: its pivots, which are eliminated in it, and the later
   nodes that they are coupled to. Of its lower triangle the pivot columns are kept, the "panel";
   the rest, the "update" matrix, waits on a stack until the parent front assembles it. Fronts of
   even and of odd depth have separate stacks, so that the update of a front never lies on top of
   those of its children. BLAS and LAPACK are those of SciPy, set by `set_blas`. Dense matrices are
   stored by columns. See symbolic_factorization.py for the terms. */

#include <string.h>

typedef long long integer;

typedef struct {
  integer nodes, fronts;
  const integer *order, *position;   /* (nodes) node at each position, and the inverse */
  const integer *front;              /* (nodes) front that eliminates the node at each position */
  const integer *start, *rows;       /* front f has positions rows[start[f] ... start[f + 1] - 1] */
  const integer *parent_row;         /* of each row except pivots: its row in the parent front */
  const integer *pivots, *parent;    /* pivots: the first rows, consecutive positions */
  const integer *depth, *subtree;    /* subtree: number of fronts; the last child of f is f - 1, the
                                        next is that less its own subtree, and so on */
  const integer *panel;              /* first block of each panel */
  double *panels, *stacks[2], *work; /* work: the largest panel, and one number per row of x */
} Symbolic;

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

/* Set the functions above, given in that order. */
DECLARE void set_blas(void **functions) {
  void *targets[] = {&dpotrf, &dpotri, &dtrsm, &dsyrk, &dsymm, &dgemm, &dtrsv, &dgemv};
  for (int k = 0; k < 8; k++) memcpy(targets[k], functions + k, sizeof(void *));
}

static integer size_of(const Symbolic *t, integer f) { return t->start[f + 1] - t->start[f]; }

static integer update_size(const Symbolic *t, integer size, integer f) {
  integer count = size * (size_of(t, f) - t->pivots[f]);
  return count * count;
}

/* Row of front f that holds a position of the front. */
static integer row_of(const Symbolic *t, integer f, integer position) {
  const integer *rows = t->rows + t->start[f];
  integer low = 0, high = size_of(t, f) - 1;
  if (position - rows[0] < t->pivots[f]) return position - rows[0];
  while (low < high) {
    integer middle = (low + high) / 2;
    if (rows[middle] < position)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

/* Index in `panels` of entry (0, 0) of the block of nodes `a` and `b`; *transposed: whether the
   block is stored transposed; *leading: the stride between columns. */
static integer locate_block(const Symbolic *t, integer size, integer a, integer b,
                            int *transposed, integer *leading) {
  integer row = t->position[a], column = t->position[b];
  *transposed = row < column;
  if (*transposed) row = t->position[b], column = t->position[a];
  integer f = t->front[column];
  *leading = size * size_of(t, f);
  return size * size * t->panel[f] + size * (column - t->rows[t->start[f]]) * *leading +
         size * row_of(t, f, row);
}

DECLARE void clear_panels(const Symbolic *t, integer size) {
  memset(t->panels, 0, sizeof(double) * size * size * t->panel[t->fronts]);
}

/* Add `count` blocks, stored by rows, between nodes rows[k] and columns[k], in either triangle; of
   diagonal blocks the lower triangle is read. */
DECLARE void add_blocks(const Symbolic *t, integer size, integer count, const integer *rows,
                        const integer *columns, const double *blocks) {
  for (integer k = 0; k < count; k++, blocks += size * size) {
    int transposed;
    integer leading, at = locate_block(t, size, rows[k], columns[k], &transposed, &leading);
    for (integer r = 0; r < size; r++)
      for (integer c = 0; c < (rows[k] == columns[k] ? r + 1 : size); c++)
        t->panels[at + (transposed ? r * leading + c : c * leading + r)] += blocks[size * r + c];
  }
}

/* Extend-add: the lower triangle of the update of child c to the panel and update of its parent. */
static void assemble_update(const Symbolic *t, integer size, integer c, const double *update,
                            double *panel, double *own) {
  integer f = t->parent[c], pivots = t->pivots[f];
  integer height = size * size_of(t, f), rest = height - size * pivots;
  integer count = size_of(t, c) - t->pivots[c];
  const integer *goal = t->parent_row + t->start[c] + t->pivots[c];
  for (integer j = 0; j < count; j++) {
    double *target = goal[j] < pivots ? panel + size * goal[j] * height
                                      : own + size * (goal[j] - pivots) * rest - size * pivots;
    integer leading = goal[j] < pivots ? height : rest;
    for (integer k = 0; k < size; k++, target += leading, update += size * count) {
      const double *from = update + size * j;
      for (integer i = j, next; i < count; i = next) {
        for (next = i + 1; next < count && goal[next] == goal[next - 1] + 1;) next++;
        double *to = target + size * goal[i];
        for (integer r = i == j ? k : 0; r < size * (next - i); r++) to[r] += from[r];
        from += size * (next - i);
      }
    }
  }
}

/* Factorize the matrix in the panels, from the leaves to the roots. Returns 0, or 1 + the node with
   a pivot of at most `min_pivot` times its diagonal entry: then the matrix is not positive
   definite, up to rounding. */
DECLARE integer factorize(const Symbolic *t, integer size, double min_pivot) {
  double *tops[2] = {t->stacks[0], t->stacks[1]}, *scale = t->work;
  for (integer f = 0; f < t->fronts; f++) {
    integer odd = t->depth[f] % 2, rest_nodes = size_of(t, f) - t->pivots[f];
    int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width, fault;
    double *panel = t->panels + size * size * t->panel[f], *own = tops[odd], *below = tops[!odd];
    for (int k = 0; k < width; k++) scale[k] = panel[k * (integer)(height + 1)];
    int has_children = t->subtree[f] > 1;
    if (has_children) memset(own, 0, sizeof(double) * rest * rest);
    for (integer c = f - 1; c > f - t->subtree[f]; c -= t->subtree[c]) { /* the last is on top */
      below -= update_size(t, size, c);
      assemble_update(t, size, c, below, panel, own);
    }
    tops[!odd] = below;
    dpotrf("L", &width, panel, &height, &fault);
    for (int k = 0; k < width; k++) {
      double root = panel[k * (integer)(height + 1)];
      if (fault == k + 1 || !(root * root > min_pivot * scale[k]))
        return 1 + t->order[t->rows[t->start[f]] + k / size];
    }
    if (!rest) continue;
    dtrsm("R", "L", "T", "N", &rest, &width, &one, panel, &height, panel + width, &height);
    dsyrk("L", "N", &rest, &width, &minus, panel + width, &height,
          has_children ? &one : &zero, own, &rest);
    tops[odd] = own + size * size * rest_nodes * rest_nodes;
  }
  return 0;
}

/* y <- L^-1 y, or L^-T y where `way` is "T", for a front's pivots; y has `count` columns. */
static void solve_pivots(const char *way, int width, int count, double *panel, int height,
                         double *y, int leading) {
  int unit = 1;
  if (count == 1)
    dtrsv("L", way, "N", &width, panel, &height, y, &unit);
  else
    dtrsm("L", "L", way, "N", &width, &count, &one, panel, &height, y, &leading);
}

/* to <- scale * op(below) * from + keep * to, `below` (rest, width) being the part of a front's
   panel under its pivots, transposed where `way` is "T". */
static void multiply_below(const char *way, int rest, int width, int count, const double *scale,
                           double *below, int height, double *from, int from_leading,
                           const double *keep, double *to, int to_leading) {
  int unit = 1, plain = way[0] == 'N', rows = plain ? rest : width, inner = plain ? width : rest;
  if (count == 1)
    dgemv(way, &rest, &width, scale, below, &height, from, &unit, keep, to, &unit);
  else
    dgemm(way, "N", &rows, &count, &inner, scale, below, &height, from, &from_leading, keep, to,
          &to_leading);
}

/* Solve in place for `count` right-hand sides x, each (nodes, size), some at a time. */
DECLARE void solve(const Symbolic *t, integer size, integer count, double *x) {
  integer length = size * t->nodes;
  double *y = t->work;
  for (integer k = 0; k < count; k += COLUMNS, x += COLUMNS * length) {
    int some = count - k < COLUMNS ? count - k : COLUMNS, leading = length;
    double *tail = y + some * length;
    for (integer c = 0; c < some; c++)
      for (integer p = 0; p < t->nodes; p++)
        memcpy(y + c * length + size * p, x + c * length + size * t->order[p],
               sizeof(double) * size);
    for (integer f = 0; f < t->fronts; f++) {
      const integer *rows = t->rows + t->start[f];
      int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width;
      double *panel = t->panels + size * size * t->panel[f], *own = y + size * rows[0];
      solve_pivots("N", width, some, panel, height, own, leading);
      if (!rest) continue;
      multiply_below("N", rest, width, some, &one, panel + width, height, own, leading, &zero,
                     tail, rest);
      for (integer c = 0, from = 0; c < some; c++)
        for (integer i = t->pivots[f]; i < size_of(t, f); i++)
          for (integer r = 0; r < size; r++) y[c * length + size * rows[i] + r] -= tail[from++];
    }
    for (integer f = t->fronts - 1; f >= 0; f--) {
      const integer *rows = t->rows + t->start[f];
      int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width;
      double *panel = t->panels + size * size * t->panel[f], *own = y + size * rows[0];
      for (integer c = 0, to = 0; c < some; c++)
        for (integer i = t->pivots[f]; i < size_of(t, f); i++)
          for (integer r = 0; r < size; r++) tail[to++] = y[c * length + size * rows[i] + r];
      if (rest)
        multiply_below("T", rest, width, some, &minus, panel + width, height, tail, rest, &one,
                       own, leading);
      solve_pivots("T", width, some, panel, height, own, leading);
    }
    for (integer c = 0; c < some; c++)
      for (integer p = 0; p < t->nodes; p++)
        memcpy(x + c * length + size * t->order[p], y + c * length + size * p,
               sizeof(double) * size);
  }
}

/* Lower triangle of the part of the inverse that child c needs, copied from that of its parent:
   `pivot_columns`, and the rest, `trailing`. */
static void gather_inverse(const Symbolic *t, integer size, integer c,
                           const double *pivot_columns, const double *trailing, double *part) {
  integer f = t->parent[c], pivots = t->pivots[f];
  integer height = size * size_of(t, f), rest = height - size * pivots;
  integer count = size_of(t, c) - t->pivots[c];
  const integer *goal = t->parent_row + t->start[c] + t->pivots[c];
  for (integer j = 0; j < count; j++) {
    const double *source = goal[j] < pivots
                               ? pivot_columns + size * goal[j] * height
                               : trailing + size * (goal[j] - pivots) * rest - size * pivots;
    integer leading = goal[j] < pivots ? height : rest;
    for (integer k = 0; k < size; k++, source += leading, part += size * count) {
      double *to = part + size * j;
      for (integer i = j, next; i < count; i = next) {
        for (next = i + 1; next < count && goal[next] == goal[next - 1] + 1;) next++;
        memcpy(to, source + size * goal[i], sizeof(double) * size * (next - i));
        to += size * (next - i);
      }
    }
  }
}

/* Diagonal blocks (nodes, size, size) of the inverse, from the roots to the leaves (Takahashi's
   equations, front by front). The factor in the panels is overwritten. */
DECLARE void diagonal_of_inverse(const Symbolic *t, integer size, double *blocks) {
  double *tops[2] = {t->stacks[0], t->stacks[1]}, *pivot_columns = t->work;
  for (integer f = t->fronts - 1; f >= 0; f--) {
    integer odd = t->depth[f] % 2, start = t->rows[t->start[f]];
    int height = size * size_of(t, f), width = size * t->pivots[f], rest = height - width, fault;
    double *panel = t->panels + size * size * t->panel[f];
    double *trailing = tops[odd] - rest * (integer)rest;
    if (rest) {
      dtrsm("R", "L", "N", "N", &rest, &width, &one, panel, &height, panel + width, &height);
      dsymm("L", "L", &rest, &width, &minus, trailing, &rest, panel + width, &height, &zero,
            pivot_columns + width, &height);
    }
    dpotri("L", &width, panel, &height, &fault);
    for (integer j = 0; j < width; j++)
      for (integer i = 0; i < width; i++)
        pivot_columns[i + j * height] = panel[i > j ? i + j * height : j + i * height];
    if (rest)
      dgemm("T", "N", &width, &width, &rest, &minus, panel + width, &height, pivot_columns + width,
            &height, &one, pivot_columns, &height);
    for (integer p = 0; p < t->pivots[f]; p++) {
      const double *corner = pivot_columns + size * p * (height + 1);
      double *block = blocks + size * size * t->order[start + p];
      for (integer i = 0; i < size; i++)
        for (integer j = 0; j <= i; j++)
          block[size * i + j] = block[size * j + i] = corner[i + j * height];
    }
    for (integer c = f - 1; c > f - t->subtree[f]; c -= t->subtree[c])
      tops[!odd] += update_size(t, size, c);
    double *top = tops[!odd]; /* the last child is the next front: it must be on top */
    for (integer c = f - 1; c > f - t->subtree[f]; c -= t->subtree[c])
      gather_inverse(t, size, c, pivot_columns, trailing, top -= update_size(t, size, c));
    tops[odd] = trailing;
  }
}
