/* Closest points on a surface of quintic patches: the nearest flat face by a tree of cylinders
   (cylinders.c comes before this text), Newton walks over the patches from there, and from every
   face that may be nearer. The walk is walk.py's, step by step. All lengths in m, in one frame. */

#define STACK 128  /* more than twice the levels of any tree */
#define RIVALS 256 /* faces that may be nearer, at most: the nearest of them */

typedef struct {
    const double *patch;     /* (m, 21, 3) */
    const double *lift;      /* (m,) bounds of the distances of patches from their flat faces */
    const int64_t *beyond;   /* (m, 3) faces across the edges, or -1 */
    const int64_t *slot;     /* (m, 3) the corners off those edges there */
    double quadratic, still; /* steps after which a walk is at its end */
    int64_t far, hops, steps;
} Surface;

typedef struct {
    int64_t face;
    double u, v, gap;
} Foot;

typedef struct {
    int count;
    Foot foot[RIVALS]; /* on the flat faces */
} Rivals;

/* S, Su, Sv, Suu, Suv, Svv (6, 3): Horner's rule in u for each power of v, then in v. */
static void evaluate(const double *c, double u, double v, double out[6][3])
{
    for (int x = 0; x < 3; x++) {
        double row[6], du[6], duu[6];
        for (int j = 0; j < 6; j++) {
            double s = 0.0, d = 0.0, dd = 0.0;
            for (int i = 5 - j; i >= 0; i--) {
                dd = dd * u + d;
                d = d * u + s;
                s = s * u + c[3 * ((i + j) * (i + j + 1) / 2 + j) + x];
            }
            row[j] = s, du[j] = d, duu[j] = 2.0 * dd;
        }
        double s = 0.0, sv = 0.0, svv = 0.0, su = 0.0, suv = 0.0, suu = 0.0;
        for (int j = 5; j >= 0; j--) {
            svv = svv * v + sv;
            sv = sv * v + s;
            s = s * v + row[j];
            suv = suv * v + su;
            su = su * v + du[j];
            suu = suu * v + duu[j];
        }
        out[0][x] = s, out[1][x] = su, out[2][x] = sv;
        out[3][x] = suu, out[4][x] = suv, out[5][x] = 2.0 * svv;
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

/* From `foot`, whose gap is filled in; gives the edges crossed, at least `far` for a held walk. */
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
    return held >= 0 && hops < surface->far ? surface->far : hops;
}

/* Squared distance of p from a triangle, and the weights of its second and third corner there. */
static double triangle(const double *corner, const double *p, double *u, double *v)
{
    double ab[3], ac[3], bc[3], ap[3], bp[3];
    for (int x = 0; x < 3; x++) {
        ab[x] = corner[3 + x] - corner[x], ac[x] = corner[6 + x] - corner[x];
        bc[x] = ac[x] - ab[x], ap[x] = p[x] - corner[x], bp[x] = ap[x] - ab[x];
    }
    double e = dot(ab, ab), f = dot(ab, ac), g = dot(ac, ac), l = dot(bc, bc);
    double x = dot(ap, ab), y = dot(ap, ac), area2 = larger(e * g - f * f, 1e-300);
    double s = (g * x - f * y) / area2, t = (e * y - f * x) / area2, best = INFINITY;
    if (s >= 0.0 && t >= 0.0 && s + t <= 1.0) {
        double r[3];
        for (int k = 0; k < 3; k++) r[k] = ap[k] - s * ab[k] - t * ac[k];
        best = dot(r, r), *u = s, *v = t;
        if (area2 > 1e-12 * e * g) return best; /* no sliver: no edge is nearer */
    }
    const double *from[3] = {ap, ap, bp}, *way[3] = {ab, ac, bc};
    const double length2[3] = {e, g, l}, along[3] = {x, y, dot(bp, bc)};
    for (int k = 0; k < 3; k++) {
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
static void note(Rivals *rivals, const Surface *surface, Foot rival, double most)
{
    if (rivals->count == RIVALS) {
        int kept = 0;
        for (int k = 0; k < RIVALS; k++) {
            Foot one = rivals->foot[k];
            if (one.gap - surface->lift[one.face] <= most) rivals->foot[kept++] = one;
        }
        rivals->count = kept;
    }
    if (rivals->count < RIVALS) {
        rivals->foot[rivals->count++] = rival;
        return;
    }
    int last = 0;
    for (int k = 1; k < RIVALS; k++)
        if (rivals->foot[k].gap > rivals->foot[last].gap) last = k;
    if (rival.gap < rivals->foot[last].gap) rivals->foot[last] = rival;
}

/* The nearest flat face; `place` is where a near one is among the leaves, then where it is. With
   `rivals`, also the faces whose patches may be nearer than its own. */
static inline Foot nearest(const Tree *tree, const Surface *surface, const double *p,
                           int64_t *place, Rivals *rivals)
{
    int64_t stack[STACK];
    double wait[STACK];
    Foot best = {tree->face[*place], 0.0, 0.0, 0.0};
    double gap2 = triangle(tree->corner + 9 * *place, p, &best.u, &best.v);
    double most = sqrt(gap2) + surface->lift[best.face]; /* the nearest patch is not farther */
    int depth = 0;
    if (rivals) rivals->count = 0;
    stack[depth] = 1, wait[depth++] = 0.0;
    while (depth) {
        int64_t node = stack[--depth];
        if (wait[depth] >= (rivals ? limit2(tree->node + node, most) : gap2)) continue;
        while (node < tree->leaves) { /* into the likelier child; the other waits */
            double one_reach, one = outside(tree->node + 2 * node, p, &one_reach);
            double two_reach, two = outside(tree->node + 2 * node + 1, p, &two_reach);
            int second = two_reach < one_reach;
            stack[depth] = 2 * node + !second, wait[depth++] = second ? one : two;
            node = 2 * node + second;
            if ((second ? two : one) >= (rivals ? limit2(tree->node + node, most) : gap2)) {
                node = 0;
                break;
            }
        }
        if (node == 0) continue;
        int64_t first = (node - tree->leaves) * tree->size;
        for (int64_t k = first; k < first + tree->size; k++) {
            double u, v, gap = triangle(tree->corner + 9 * k, p, &u, &v);
            if (gap < gap2) gap2 = gap, best = (Foot){tree->face[k], u, v, 0.0}, *place = k;
            if (!rivals) continue;
            Foot rival = {tree->face[k], u, v, sqrt(gap)};
            most = smaller(most, rival.gap + surface->lift[rival.face]);
            if (rival.gap - surface->lift[rival.face] <= most) note(rivals, surface, rival, most);
        }
    }
    best.gap = sqrt(gap2);
    return best;
}

/* Walk from all faces whose patches may be nearer than `best`: from the rivals' feet on their flat
   faces, or from their middles. */
static void challenge(const Surface *surface, const double *p, const Rivals *rivals, int middles,
                      Foot *best)
{
    for (int k = 0; k < rivals->count; k++) {
        Foot other = rivals->foot[k];
        if (other.gap - surface->lift[other.face] >= 0.9999 * best->gap) continue;
        if (!middles && other.face == best->face) continue;
        if (middles) other.u = other.v = 1.0 / 3.0;
        walk(surface, p, &other);
        if (other.gap < best->gap) *best = other;
    }
}

/* Feet of n points, one after the other in `sequence` (n,): faces (n,), uv (n, 2) and the patches'
   derivatives there (6, n, 3). With `warm`, `face` holds the faces to start from; without,
   `flat_face`, `flat_uv` and `flat_gap` are filled with the nearest flat faces. `sharp` surfaces have creases, borders or walls: there the nearest
   flat face may mislead. */
void closest(const Tree *tree, const Surface *surface, int64_t n, const int64_t *sequence,
             const double *points, int warm, int sharp, int64_t *face, double *uv,
             double *out, int64_t *flat_face, double *flat_uv, double *flat_gap)
{
    Rivals rivals;
    int64_t place = 0;
    for (int64_t row = 0; row < n; row++) {
        int64_t k = sequence[row], hops = surface->far;
        const double *p = points + 3 * k;
        Foot best = {face[k], 1.0 / 3.0, 1.0 / 3.0, INFINITY};
        if (warm) hops = walk(surface, p, &best);
        if (hops >= surface->far) { /* come from far, or held: look over all */
            Foot flat = sharp ? nearest(tree, surface, p, &place, &rivals)
                              : nearest(tree, surface, p, &place, 0);
            Foot other = flat;
            double most = flat.gap + surface->lift[flat.face];
            if (!warm) {
                flat_face[k] = flat.face, flat_gap[k] = flat.gap;
                flat_uv[2 * k] = flat.u, flat_uv[2 * k + 1] = flat.v;
            }
            walk(surface, p, &other);
            if (other.gap < best.gap) best = other;
            if (sharp) challenge(surface, p, &rivals, 0, &best);
            if (sharp && best.gap > 1.0001 * most) challenge(surface, p, &rivals, 1, &best);
        }
        face[k] = best.face, uv[2 * k] = best.u, uv[2 * k + 1] = best.v;
        keep(surface, n, k, best.face, uv + 2 * k, out);
    }
}

/* The feet that walks from `face` (n,) end in: local minima of the distance. */
void descend(const Surface *surface, int64_t n, const double *points, int64_t *face, double *uv)
{
    for (int64_t k = 0; k < n; k++) {
        Foot foot = {face[k], 1.0 / 3.0, 1.0 / 3.0, 0.0};
        walk(surface, points + 3 * k, &foot);
        face[k] = foot.face, uv[2 * k] = foot.u, uv[2 * k + 1] = foot.v;
    }
}
