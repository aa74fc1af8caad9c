/* Placed before generated code that runs at every step. */

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
#define CASADI_SYMBOL_EXPORT static inline

/* fmax and fmin as one instruction each; if one argument is NaN, the result is the second. */
static inline double larger(double x, double y) { return x > y ? x : y; }
static inline double smaller(double x, double y) { return x < y ? x : y; }
#define fmax larger
#define fmin smaller
