/* What CasADi's libraries need of a BLAS and SciPy does not offer; dgemm_ is declared before. */

static int (*its_ilaenv)(int *, char *, char *, int *, int *, int *, int *, long, long);
int ilaenv_(int *spec, char *name, char *options, int *a, int *b, int *c, int *d, long l, long m) {
  return its_ilaenv(spec, name, options, a, b, c, d, l, m);
}

/* C = the triangle of alpha op(A) op(B) + beta C, n x n: GEMMT, BLOCK columns at a time. */

#define BLOCK 64

static double *entry(double *matrix, int row, int column, int leading) {
  return matrix + row + (long long)column * leading;
}

void dgemmt_(char *uplo, char *trans_a, char *trans_b, int *n, int *k, void *alpha, double *a,
             int *lda, double *b, int *ldb, double *beta, double *c, int *ldc) {
  double own[BLOCK * BLOCK], zero = 0.0;
  const int lower = *uplo == 'L' || *uplo == 'l', height = BLOCK;
  const int plain_a = *trans_a == 'N' || *trans_a == 'n';
  const int plain_b = *trans_b == 'N' || *trans_b == 'n';
  for (int j = 0; j < *n; j += BLOCK) {
    int width = *n - j < BLOCK ? *n - j : BLOCK;
    int first = lower ? j + width : 0, rows = lower ? *n - first : j;
    double *right = plain_b ? entry(b, 0, j, *ldb) : entry(b, j, 0, *ldb);
    double *left = plain_a ? entry(a, j, 0, *lda) : entry(a, 0, j, *lda);
    dgemm_(trans_a, trans_b, &width, &width, k, alpha, left, lda, right, ldb, &zero, own,
           (void *)&height);
    for (int q = 0; q < width; q++)
      for (int p = lower ? q : 0; p < (lower ? width : q + 1); p++) {
        double *here = entry(c, j + p, j + q, *ldc);
        *here = (*beta == 0.0 ? 0.0 : *beta * *here) + own[p + BLOCK * q];
      }
    left = plain_a ? entry(a, first, 0, *lda) : entry(a, 0, first, *lda);
    if (rows > 0)
      dgemm_(trans_a, trans_b, &rows, &width, k, alpha, left, lda, right, ldb, beta,
             entry(c, first, j, *ldc), ldc);
  }
}
