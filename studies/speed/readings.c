/* Point pressures of Hertz contacts: p = p_0 sqrt(1 - r^2 / a^2) at every taxel.

   POINT, NORMAL, FORCE, DEPTH, RADIUS and OUTPUT are the layout of a step's output; MIN_AREA,
   in m^2, is the least a^2. */

#define PI 3.14159265358979323846

/* p (count, taxels), Pa, of `outputs` (count, OUTPUT) at taxels x (3, taxels), m. A taxel off the
   contact's tangent plane is projected onto it, up to a height of a: beyond, it reads nothing. */
#define READ(name, real, root)                                                                      \
  EXPORT void name(int64_t count, int64_t taxels, const real *x, const double *outputs, real *p) {  \
    for (int64_t k = 0; k < count; k++, outputs += OUTPUT, p += taxels) {                           \
      const double *c = outputs + POINT, *n = outputs + NORMAL, force = outputs[FORCE];             \
      const double area = fmax(outputs[DEPTH] * outputs[RADIUS], MIN_AREA);                             \
      const real cx = c[0], cy = c[1], cz = c[2], nx = n[0], ny = n[1], nz = n[2];                  \
      const real inverse = 1.0 / area, peak = 1.5 / PI * fmax(force, 0.0) / area, one = 1, none = 0; \
      for (int64_t i = 0; i < taxels; i++) {                                                        \
        real dx = x[i] - cx, dy = x[taxels + i] - cy, dz = x[2 * taxels + i] - cz;                  \
        real height = dx * nx + dy * ny + dz * nz, off = height * height * inverse;                 \
        real inside = one - (dx * dx + dy * dy + dz * dz) * inverse + (off < one ? off : one);      \
        p[i] = peak * root(inside > none ? inside : none);                                          \
      }                                                                                             \
    }                                                                                               \
  }

READ(read_double, double, sqrt)
READ(read_float, float, sqrtf)
