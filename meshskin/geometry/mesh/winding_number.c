/* Winding numbers: the sum of the solid angles of triangles, and of whole clusters of them from a
   distance. Barill, Dickson, Schmidt, Levin, Jacobson, "Fast winding numbers for soups and
   clouds" (ACM Trans. Graphics 37, 2018), with the first term of the expansion. */

#include <math.h>
#include <stdint.h>

#define STACK 128 /* more than twice the levels of any tree */
#define PI 3.14159265358979323846

typedef struct {
    double centre[3], area[3], reach; /* area: vector sum; reach: the distance that counts as far */
} Cluster;

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Half the solid angle of a triangle: Van Oosterom and Strackee, "The Solid Angle of a Plane
   Triangle" (1983). */
static double half_angle(const double *corner, const double *p)
{
    double a[3], b[3], c[3];
    for (int x = 0; x < 3; x++) {
        a[x] = corner[x] - p[x], b[x] = corner[3 + x] - p[x], c[x] = corner[6 + x] - p[x];
    }
    double cross[3] = {b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2],
                       b[0] * c[1] - b[1] * c[0]};
    double la = sqrt(dot(a, a)), lb = sqrt(dot(b, b)), lc = sqrt(dot(c, c));
    return atan2(dot(a, cross), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
}

/* Winding numbers (n,) of points (n, 3); triangles (leaves * size, 9), leaf by leaf, of which those
   that fill up a leaf have no area; node k of the clusters (2 leaves,) has the children 2 k and 2 k + 1. */
void winding(int64_t leaves, int64_t size, const Cluster *node, const double *corner, int64_t n,
             const double *points, double *total)
{
    int64_t stack[STACK];
    for (int64_t k = 0; k < n; k++) {
        const double *p = points + 3 * k;
        double near = 0.0, far = 0.0;
        int depth = 0;
        stack[depth++] = 1;
        while (depth) {
            int64_t here = stack[--depth];
            const Cluster *c = node + here;
            double q[3] = {c->centre[0] - p[0], c->centre[1] - p[1], c->centre[2] - p[2]};
            double away2 = dot(q, q);
            if (away2 > c->reach * c->reach) {
                far += dot(c->area, q) / (away2 * sqrt(away2));
            } else if (here < leaves) {
                stack[depth++] = 2 * here, stack[depth++] = 2 * here + 1;
            } else {
                const double *first = corner + 9 * size * (here - leaves);
                for (int64_t i = 0; i < size; i++) near += half_angle(first + 9 * i, p);
            }
        }
        total[k] = near / (2.0 * PI) + far / (4.0 * PI);
    }
}

typedef struct {
    double centre[3], area[3], direction[3], reach; /* area: vector sum of the caps of the loop */
} Loop;

/* The part of a border edge (6,), extruded to infinity along a direction (3,), times 2 pi: the
   limit of `half_angle` for a corner that is infinitely far away. */
static double strip(const double *edge, const double *d, const double *p)
{
    const double *tail = edge, *head = edge + 3;
    double a[3], b[3]; /* against the mesh */
    for (int x = 0; x < 3; x++) a[x] = head[x] - p[x], b[x] = tail[x] - p[x];
    double cross[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2],
                       a[0] * b[1] - a[1] * b[0]};
    double la = sqrt(dot(a, a)), lb = sqrt(dot(b, b));
    return atan2(dot(cross, d), la * lb + dot(a, b) + dot(b, d) * la + dot(a, d) * lb);
}

/* Adds to `total` (n,) the parts due to the loops of the border, of which loop j has the edges from
   first[j] to first[j + 1]. A loop's extrusion and its caps enclose a cylinder without an end:
   outside of it, the part is that of the caps, and far from it that of their vector area. */
void extruded(int64_t loops, const Loop *loop, const int64_t *first, const double *edge, int64_t n,
              const double *points, double *total)
{
    for (int64_t i = 0; i < n; i++) {
        const double *p = points + 3 * i;
        double near = 0.0, far = 0.0;
        for (int64_t j = 0; j < loops; j++) {
            const Loop *c = loop + j;
            double q[3] = {c->centre[0] - p[0], c->centre[1] - p[1], c->centre[2] - p[2]};
            double away2 = dot(q, q), ahead = -dot(q, c->direction);
            double aside2 = ahead > 0.0 ? away2 - ahead * ahead : away2;
            if (aside2 > c->reach * c->reach) {
                far += dot(c->area, q) / (away2 * sqrt(away2));
            } else {
                for (int64_t e = first[j]; e < first[j + 1]; e++) {
                    near += strip(edge + 6 * e, c->direction, p);
                }
            }
        }
        total[i] += near / (2.0 * PI) + far / (4.0 * PI);
    }
}
