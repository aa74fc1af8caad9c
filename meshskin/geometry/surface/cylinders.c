/* A tree of cylinders over triangles, each about the mean normal of what it holds: on a smooth
   surface they are flat, and few of them are as near to a point as the nearest triangle is. */

#include <math.h>
#include <stdint.h>

typedef struct {
    double centre[3], normal[3], radius, half; /* half: of its height; 64 bytes, a line of cache */
} Cylinder;

typedef struct {
    int64_t levels, leaves, faces; /* 2^levels leaves share the faces */
    const Cylinder *node;   /* (2 leaves,) hulls; node k has the children 2 k and 2 k + 1 */
    const double *corner;   /* (faces, 9) corners of the faces, leaf by leaf */
    const double *lift;     /* (faces,) how far their patches may be from them */
    const int64_t *face;    /* (faces,) their numbers */
} Tree;

/* Where part k of 2^levels begins among n faces; parts of parts begin where they do. */
static inline int64_t start(int64_t k, int64_t levels, int64_t n) { return k * n >> levels; }

static inline double larger(double a, double b) { return a > b ? a : b; }

static inline double smaller(double a, double b) { return a < b ? a : b; }

static double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* A bound of the squared distance of p from what is in a cylinder; `reach`: more than it by the
   squared distance of p from the centre, a guess at which cylinder holds the nearest triangle. */
static double outside(const Cylinder *c, const double *p, double *reach)
{
    double q[3] = {p[0] - c->centre[0], p[1] - c->centre[1], p[2] - c->centre[2]};
    double along = dot(q, c->normal), whole = dot(q, q), across2 = whole - along * along;
    double above = larger(fabs(along) - c->half, 0.0);
    double beside = across2 > c->radius * c->radius ? sqrt(across2) - c->radius : 0.0;
    *reach = above * above + beside * beside + whole;
    return above * above + beside * beside;
}

typedef struct {
    double at[3];
    int64_t face;
} Spot;

/* Reorder n spots so that the first `half` have the smaller coordinates x: Hoare's selection. */
static void halve(Spot *spot, int64_t n, int64_t half, int x)
{
    int64_t low = 0, high = n - 1;
    while (low < high) {
        double pivot = spot[low + (high - low) / 2].at[x];
        int64_t i = low, j = high;
        while (i <= j) {
            while (spot[i].at[x] < pivot) i++;
            while (spot[j].at[x] > pivot) j--;
            if (i > j) break;
            Spot swap = spot[i];
            spot[i++] = spot[j], spot[j--] = swap;
        }
        if (half <= j) high = j;
        else if (half >= i) low = i;
        else break;
    }
}

/* Put the middles of faces (faces,) in the order of the leaves of a balanced tree: halved, from the
   whole down, across their longest extent. */
void order(int64_t levels, int64_t faces, Spot *spot)
{
    for (int64_t level = 0; level < levels; level++)
        for (int64_t block = 0; block < (int64_t)1 << level; block++) {
            int64_t first = start(block, level, faces);
            int64_t half = start(2 * block + 1, level + 1, faces) - first;
            int64_t n = start(block + 1, level, faces) - first;
            Spot *here = spot + first;
            double low[3] = {INFINITY, INFINITY, INFINITY}, extent[3], high[3];
            for (int x = 0; x < 3; x++) high[x] = -INFINITY;
            for (int64_t k = 0; k < n; k++)
                for (int x = 0; x < 3; x++) {
                    low[x] = smaller(low[x], here[k].at[x]);
                    high[x] = larger(high[x], here[k].at[x]);
                }
            for (int x = 0; x < 3; x++) extent[x] = high[x] - low[x];
            int longest = extent[1] > extent[0];
            if (extent[2] > extent[longest]) longest = 2;
            halve(here, n, half, longest);
        }
}

/* The cylinder about n triangles (n, 9) and what is within `lift` of them: its axis is the mean of
   their normals. */
static Cylinder hull(const double *corner, int64_t n, double lift)
{
    Cylinder c = {{0.0}, {0.0}, 0.0, 0.0};
    double low = INFINITY, high = -INFINITY, radius2 = 0.0;
    for (int64_t k = 0; k < n; k++) {
        const double *a = corner + 9 * k, *b = a + 3, *d = a + 6;
        for (int x = 0; x < 3; x++) {
            int y = (x + 1) % 3, z = (x + 2) % 3;
            c.centre[x] += (a[x] + b[x] + d[x]) / (3.0 * (double)n);
            c.normal[x] += (b[y] - a[y]) * (d[z] - a[z]) - (b[z] - a[z]) * (d[y] - a[y]);
        }
    }
    double length = sqrt(dot(c.normal, c.normal));
    if (!(length > 0.0)) c.normal[0] = length = 1.0;
    for (int x = 0; x < 3; x++) c.normal[x] /= length;
    for (int64_t k = 0; k < 3 * n; k++) {
        double q[3], along;
        for (int x = 0; x < 3; x++) q[x] = corner[3 * k + x] - c.centre[x];
        along = dot(q, c.normal);
        low = smaller(low, along), high = larger(high, along);
        for (int x = 0; x < 3; x++) q[x] -= along * c.normal[x];
        radius2 = larger(radius2, dot(q, q));
    }
    for (int x = 0; x < 3; x++) c.centre[x] += 0.5 * (low + high) * c.normal[x];
    c.radius = sqrt(radius2) + lift, c.half = 0.5 * (high - low) + lift;
    return c;
}

/* The cylinders of a tree from the corners and lifts of its faces, leaf by leaf. */
void enclose(int64_t levels, int64_t faces, const double *corner, const double *lift,
             Cylinder *node)
{
    for (int64_t level = levels; level >= 0; level--)
        for (int64_t block = 0, blocks = (int64_t)1 << level; block < blocks; block++) {
            int64_t first = start(block, level, faces), last = start(block + 1, level, faces);
            double most = 0.0;
            for (int64_t k = first; k < last; k++) most = larger(most, lift[k]);
            node[blocks + block] = hull(corner + 9 * first, last - first, most);
        }
    node[0] = node[1];
}
