/* Closest points of a surface of quintic patches: the nearest flat face by a tree of cylinders
   (cylinders.c precedes this text), and Newton's method over the patches from there, and from every
   face that may be nearer. The iteration is that of newton.py, from which rays and the reference
   search take it. All lengths in m, in one frame. */

#define STACK 128  /* more than twice the levels of any tree */
#define LEAF 4     /* faces in a leaf, at most, as in compiled_search.py */
#define RIVALS 256 /* faces that may be nearer, at most: the nearest of them */

typedef struct {
    const double *patch;     /* (m, 21, 3) */
    const int64_t *beyond;   /* (m, 3) faces across the edges, or -1 */
    const int64_t *slot;     /* (m, 3) the corners off those edges there */
    double quadratic, still; /* largest last steps */
    int64_t far, hops, steps;
} Surface;

typedef struct {
    int64_t face;
    double u, v, gap;
} Foot;

typedef struct {
    Foot foot;   /* on the flat face */
    double lift; /* how far the patch may be from it */
} Rival;

typedef struct {
    int count;
    Rival one[RIVALS];
} Rivals;

/* What is known of the faces near a point: where the nearest is among the leaves, its foot, squared
   distance and lift, the distance that the nearest patch is within, and the faces whose patches may
   be nearer than the nearest face's own, where they are asked for. */
typedef struct {
    int64_t place;
    Foot foot;
    double gap2, lift, most;
    Rivals *rivals;
} Near;

/* Have some bytes brought into the cache. Always inline: gcc takes a function that does no more for
   one without effect, and drops it. */
#ifdef __GNUC__
#define ALWAYS inline __attribute__((always_inline))
static ALWAYS void fetch(const void *from, int64_t bytes)
{
    for (int64_t k = 0; k < bytes; k += 64) __builtin_prefetch((const char *)from + k);
}
#else
#define ALWAYS inline
static void fetch(const void *from, int64_t bytes) { (void)from, (void)bytes; }
#endif

/* S, Su, Sv, Suu, Suv, Svv (6, 3): Horner's rule in u for each power of v, within that in v. */
static void evaluate(const double *c, double u, double v, double out[6][3])
{
    double s[3] = {0.0}, su[3] = {0.0}, sv[3] = {0.0};
    double suu[3] = {0.0}, suv[3] = {0.0}, svv[3] = {0.0};
    for (int j = 5; j >= 0; j--) {
        double r[3] = {0.0}, d[3] = {0.0}, dd[3] = {0.0};
        for (int i = 5 - j; i >= 0; i--) {
            const double *a = c + 3 * ((i + j) * (i + j + 1) / 2 + j);
            for (int x = 0; x < 3; x++) {
                dd[x] = dd[x] * u + d[x];
                d[x] = d[x] * u + r[x];
                r[x] = r[x] * u + a[x];
            }
        }
        for (int x = 0; x < 3; x++) {
            svv[x] = svv[x] * v + sv[x];
            sv[x] = sv[x] * v + s[x];
            s[x] = s[x] * v + r[x];
            suv[x] = suv[x] * v + su[x];
            su[x] = su[x] * v + d[x];
            suu[x] = suu[x] * v + 2.0 * dd[x];
        }
    }
    for (int x = 0; x < 3; x++) {
        out[0][x] = s[x], out[1][x] = su[x], out[2][x] = sv[x];
        out[3][x] = suu[x], out[4][x] = suv[x], out[5][x] = 2.0 * svv[x];
    }
}

/* The derivatives at the foot of row k of n: out (6, n, 3). */
static void keep(const Surface *surface, int64_t n, int64_t k, int64_t face, const double *uv,
                 double *out)
{
    double d[6][3];
    evaluate(surface->patch + 63 * face, uv[0], uv[1], d);
    for (int row = 0; row < 6; row++)
        for (int x = 0; x < 3; x++) out[(row * n + k) * 3 + x] = d[row][x];
}

void derivatives(const Surface *surface, int64_t n, const int64_t *face, const double *uv,
                 double *out)
{
    for (int64_t k = 0; k < n; k++) keep(surface, n, k, face[k], uv + 2 * k, out);
}

/* From `foot`, whose gap is filled in; gives the edges crossed, at least `far` for a held walk, and
   for one that ends farther from p than half a face's edge: another side may be nearer. */
static int64_t walk(const Surface *surface, const double *p, Foot *foot)
{
    static const int after[3] = {1, 2, 0}, before[3] = {2, 0, 1};
    static const double corner[3][2] = {{0.0, 0.0}, {1.0, 0.0}, {0.0, 1.0}};
    int64_t face = foot->face, came = -1, hops = 0, back = 0;
    double u = foot->u, v = foot->v;
    int held = -1;
    for (int64_t k = 0; k < surface->steps; k++) {
        double d[6][3], r[3];
        evaluate(surface->patch + 63 * face, u, v, d);
        for (int x = 0; x < 3; x++) r[x] = d[0][x] - p[x];
        double gu = dot(r, d[1]), gv = dot(r, d[2]);
        double e = dot(d[1], d[1]), f = dot(d[1], d[2]), g = dot(d[2], d[2]);
        double a = e + dot(r, d[3]), b = f + dot(r, d[4]), c = g + dot(r, d[5]);
        int newton = a > 0.0 && a * c - b * b > 1e-3 * (e * g - f * f);
        if (!newton) a = e, b = f, c = g;
        double determinant = a * c - b * b;
        if (!(fabs(determinant) > 1e-300)) determinant = 1e-300;
        double mu = (b * gv - c * gu) / determinant, mv = (b * gu - a * gv) / determinant;
        if (held >= 0) { /* along the edge only */
            double du = corner[before[held]][0] - corner[after[held]][0];
            double dv = corner[before[held]][1] - corner[after[held]][1];
            double bend = a * du * du + 2.0 * b * du * dv + c * dv * dv;
            double t = -(gu * du + gv * dv) / larger(bend, 1e-300);
            mu = t * du, mv = t * dv;
        }
        if (k > surface->steps / 4) mu *= 0.5, mv *= 0.5;
        double size = larger(fabs(mu), fabs(mv));
        if (size > 1.0) mu /= size, mv /= size;
        double now[3] = {1.0 - u - v, u, v}, change[3] = {-mu - mv, mu, mv}, least = INFINITY;
        int leaves = -1;
        for (int q = 0; q < 3; q++) {
            if (q == held || !(now[q] + change[q] < 0.0)) continue;
            double share = larger(now[q], 0.0) / -change[q];
            if (share < least) least = share, leaves = q;
        }
        if (leaves >= 0) mu *= least, mv *= least;
        u += mu, v += mv;
        if (leaves >= 0) {
            if (held >= 0) break; /* at the edge's end */
            int64_t beyond = surface->beyond[3 * face + leaves];
            back += beyond == came;
            if (beyond < 0 || back > 1 || hops >= surface->hops) {
                held = leaves;
                continue;
            }
            int slot = (int)surface->slot[3 * face + leaves];
            double weight[3] = {1.0 - u - v, u, v}, there[3] = {0.0, 0.0, 0.0};
            double head = smaller(larger(weight[before[leaves]], 0.0), 1.0);
            there[after[slot]] = head, there[before[slot]] = 1.0 - head;
            u = there[1], v = there[2];
            came = face, face = beyond;
            hops++;
        } else if (size < (newton ? surface->quadratic : surface->still)) {
            break;
        }
    }
    double d[6][3], gap = 0.0;
    evaluate(surface->patch + 63 * face, u, v, d);
    for (int x = 0; x < 3; x++) gap += (d[0][x] - p[x]) * (d[0][x] - p[x]);
    foot->face = face, foot->u = u, foot->v = v, foot->gap = sqrt(gap);
    int beyond = held >= 0 || 4.0 * gap > larger(dot(d[1], d[1]), dot(d[2], d[2]));
    return beyond && hops < surface->far ? surface->far : hops;
}

/* Squared distance of p from a triangle, and the weights of its second and third corner there. */
static inline double triangle(const double *corner, const double *p, double *u, double *v)
{
    double ab[3], ac[3], bc[3], ap[3], bp[3];
    for (int x = 0; x < 3; x++) {
        ab[x] = corner[3 + x] - corner[x], ac[x] = corner[6 + x] - corner[x];
        bc[x] = ac[x] - ab[x], ap[x] = p[x] - corner[x], bp[x] = ap[x] - ab[x];
    }
    double e = dot(ab, ab), f = dot(ab, ac), g = dot(ac, ac);
    double x = dot(ap, ab), y = dot(ap, ac), area2 = larger(e * g - f * f, 1e-300);
    double s = g * x - f * y, t = e * y - f * x, best = INFINITY;
    int sliver = !(area2 > 1e-12 * e * g), beyond[3] = {t < 0.0, s < 0.0, s + t > area2};
    if (!beyond[0] && !beyond[1] && !beyond[2]) {
        double r[3];
        s /= area2, t /= area2;
        for (int k = 0; k < 3; k++) r[k] = ap[k] - s * ab[k] - t * ac[k];
        best = dot(r, r), *u = s, *v = t;
        if (!sliver) return best;
    }
    const double *from[3] = {ap, ap, bp}, *way[3] = {ab, ac, bc};
    const double length2[3] = {e, g, dot(bc, bc)}, along[3] = {x, y, dot(bp, bc)};
    for (int k = 0; k < 3; k++) {
        if (!beyond[k] && !sliver) continue; /* the nearest edge is one that p is beyond */
        double q = smaller(larger(along[k] / larger(length2[k], 1e-300), 0.0), 1.0), r[3];
        for (int i = 0; i < 3; i++) r[i] = from[k][i] - q * way[k][i];
        double gap = dot(r, r);
        if (gap < best) {
            best = gap;
            *u = k == 0 ? q : k == 1 ? 0.0 : 1.0 - q;
            *v = k == 0 ? 0.0 : q;
        }
    }
    return best;
}

/* Add a rival; where there is no room, after those that have become too far are dropped, the
   farthest gives way. */
static void note(Rivals *rivals, Rival rival, double most)
{
    if (rivals->count == RIVALS) {
        int kept = 0;
        for (int k = 0; k < RIVALS; k++) {
            Rival one = rivals->one[k];
            if (one.foot.gap - one.lift <= most) rivals->one[kept++] = one;
        }
        rivals->count = kept;
    }
    if (rivals->count < RIVALS) {
        rivals->one[rivals->count++] = rival;
        return;
    }
    int last = 0;
    for (int k = 1; k < RIVALS; k++)
        if (rivals->one[k].foot.gap > rivals->one[last].foot.gap) last = k;
    if (rival.foot.gap < rivals->one[last].foot.gap) rivals->one[last] = rival;
}

/* The squared distance from which nothing is wanted any more; a little more, for rounding. */
static inline double limit2(const Near *near, double lift)
{
    double reach = (1.0 + 1e-12) * (near->most + lift);
    return near->rivals ? reach * reach : near->gap2;
}

/* Look at the faces of a leaf. */
static inline void look(const Tree *tree, const double *p, int64_t leaf, Near *near)
{
    int64_t last = start(leaf + 1, tree->levels, tree->faces);
    for (int64_t k = start(leaf, tree->levels, tree->faces); k < last; k++) {
        double u, v, gap2 = triangle(tree->corner + 9 * k, p, &u, &v);
        if (gap2 < near->gap2) {
            near->gap2 = gap2, near->place = k, near->lift = tree->lift[k];
            near->foot = (Foot){tree->face[k], u, v, 0.0};
        }
        if (!near->rivals || gap2 > limit2(near, tree->lift[k])) continue;
        Rival rival = {{tree->face[k], u, v, sqrt(gap2)}, tree->lift[k]};
        near->most = smaller(near->most, rival.foot.gap + rival.lift);
        note(near->rivals, rival, near->most);
    }
}

/* Have what the next step from node `first` or the one after it looks at brought into the cache. */
static ALWAYS void prepare(const Tree *tree, int64_t first)
{
    if (first < tree->leaves) {
        fetch(tree->node + 2 * first, 4 * sizeof(Cylinder));
    } else {
        int64_t face = start(first - tree->leaves, tree->levels, tree->faces);
        fetch(tree->corner + 9 * face, 2 * LEAF * 9 * sizeof(double));
    }
}

/* Look at all leaves that may hold what is wanted, the likelier first. */
static void search(const Tree *tree, const double *p, Near *near)
{
    int64_t stack[STACK];
    double wait[STACK];
    int depth = 1;
    stack[0] = 1, wait[0] = 0.0;
    while (depth) {
        int64_t node = stack[--depth];
        double least = wait[depth];
        while (least < limit2(near, 0.0)) {
            if (node >= tree->leaves) {
                look(tree, p, node - tree->leaves, near);
                break;
            }
            prepare(tree, 2 * node);
            double one_reach, one = outside(tree->node + 2 * node, p, &one_reach);
            double two_reach, two = outside(tree->node + 2 * node + 1, p, &two_reach);
            int second = two_reach < one_reach; /* the other waits */
            stack[depth] = 2 * node + !second, wait[depth++] = second ? one : two;
            node = 2 * node + second, least = second ? two : one;
        }
    }
}

/* The nearest flat face: `place`, a near one, tells what need not be looked at. */
static Near nearest(const Tree *tree, const double *p, int64_t place, Rivals *rivals)
{
    Near near = {place, {tree->face[place], 0.0, 0.0, 0.0}, 0.0, tree->lift[place], 0.0, rivals};
    near.gap2 = triangle(tree->corner + 9 * place, p, &near.foot.u, &near.foot.v);
    near.most = sqrt(near.gap2) + near.lift;
    if (rivals) rivals->count = 0;
    search(tree, p, &near);
    near.foot.gap = sqrt(near.gap2);
    return near;
}

/* Walk from all faces whose patches may be nearer than `best`: from the rivals' feet on their flat
   faces, or from their middles. */
static void challenge(const Surface *surface, const double *p, const Rivals *rivals, int middles,
                      Foot *best)
{
    for (int k = 0; k < rivals->count; k++) {
        Foot other = rivals->one[k].foot;
        if (other.gap - rivals->one[k].lift >= 0.9999 * best->gap) continue;
        if (!middles && other.face == best->face) continue;
        if (middles) other.u = other.v = 1.0 / 3.0;
        walk(surface, p, &other);
        if (other.gap < best->gap) *best = other;
    }
}

/* The foot from the nearest flat faces, if it is nearer than `best`. */
static void settle(const Surface *surface, const double *p, const Near *near, Foot *best)
{
    Foot other = near->foot;
    double most = near->foot.gap + near->lift;
    walk(surface, p, &other);
    if (other.gap < best->gap) *best = other;
    if (!near->rivals) return;
    challenge(surface, p, near->rivals, 0, best);
    if (best->gap > 1.0001 * most) challenge(surface, p, near->rivals, 1, best);
}

/* Feet of n points, one after the other in `sequence` (n,): faces (n,), uv (n, 2) and the patches'
   derivatives there (6, n, 3). With `warm`, `face` holds the faces to start from; without,
   `flat_face`, `flat_uv` and `flat_gap` are filled with the nearest flat faces. `sharp` surfaces
   have creases, borders or walls: there the nearest flat face may mislead. The next point's flat
   face is found before the walk to this one's foot: its patch comes into the cache meanwhile. */
void closest(const Tree *tree, const Surface *surface, int64_t n, const int64_t *sequence,
             const double *points, int warm, int sharp, int64_t *face, double *uv,
             double *out, int64_t *flat_face, double *flat_uv, double *flat_gap)
{
    Rivals rivals[2];
    Near near = {0}, next = {0};
    for (int64_t row = -1; row < n; row++) {
        near = next;
        if (row + 1 < n && !warm) {
            Rivals *room = sharp ? rivals + (row & 1) : 0;
            next = nearest(tree, points + 3 * sequence[row + 1], near.place, room);
            fetch(surface->patch + 63 * next.foot.face, 63 * sizeof(double));
        }
        if (row < 0) continue;
        int64_t k = sequence[row];
        const double *p = points + 3 * k;
        Foot best = {face[k], 1.0 / 3.0, 1.0 / 3.0, INFINITY};
        if (!warm) {
            flat_face[k] = near.foot.face, flat_gap[k] = near.foot.gap;
            flat_uv[2 * k] = near.foot.u, flat_uv[2 * k + 1] = near.foot.v;
            settle(surface, p, &near, &best);
        } else if (walk(surface, p, &best) >= surface->far) { /* come from far, or held */
            next = nearest(tree, p, near.place, sharp ? rivals : 0);
            settle(surface, p, &next, &best);
        }
        face[k] = best.face, uv[2 * k] = best.u, uv[2 * k + 1] = best.v;
        keep(surface, n, k, best.face, uv + 2 * k, out);
    }
}

/* The nearest flat faces of n points, one after the other in `sequence` (n,): faces (n,), uv (n, 2),
   distances (n,). Each is searched from the same place: where two faces are as near, at an edge, it
   must not be the points before that decide. */
void flat(const Tree *tree, int64_t n, const int64_t *sequence, const double *points,
          int64_t *face, double *uv, double *gap)
{
    for (int64_t row = 0; row < n; row++) {
        int64_t k = sequence[row];
        Near near = nearest(tree, points + 3 * k, 0, 0);
        face[k] = near.foot.face, gap[k] = near.foot.gap;
        uv[2 * k] = near.foot.u, uv[2 * k + 1] = near.foot.v;
    }
}
