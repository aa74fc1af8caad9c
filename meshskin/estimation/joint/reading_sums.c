/* Sums over the readings of taxels and contacts (reading_sums.py).

   A reading r belongs to taxel[r] and contact[r]; its derivatives are a row of `jacobian`:
   `size` of its taxel's unknowns, `shared` of the global parameters, 3 of its contact's. */

typedef long long integer;

/* to (rows, columns) += weight * a b^T */
static void add_outer(double *restrict to, const double *restrict a, integer rows,
                      const double *restrict b, integer columns, double weight) {
  for (integer i = 0; i < rows; i++) {
    double scaled = weight * a[i];
    for (integer j = 0; j < columns; j++) to[i * columns + j] += scaled * b[j];
  }
}

static void add_scaled(double *restrict to, const double *restrict a, integer count, double by) {
  for (integer i = 0; i < count; i++) to[i] += by * a[i];
}

/* Blocks of the normal equations, and the gradient's parts; `coupling` (count, size, 3) is that of
   each reading's taxel and contact. All sums start from what the arrays hold. */
DECLARE void normal_equations(integer count, integer size, integer shared, const integer *taxel,
                              const integer *contact, const double *jacobian, const double *rate,
                              const double *curvature, double *taxels, double *contacts,
                              double *common, double *coupling, double *taxel_common,
                              double *contact_common, double *by_taxel, double *by_contact,
                              double *by_common) {
  integer width = size + shared + 3;
  for (integer r = 0; r < count; r++, jacobian += width, coupling += 3 * size) {
    integer t = taxel[r], c = contact[r];
    const double *own = jacobian, *all = jacobian + size, *at = jacobian + size + shared;
    double weight = curvature[r], slope = rate[r];
    add_scaled(by_taxel + size * t, own, size, slope);
    add_scaled(by_common, all, shared, slope);
    add_scaled(by_contact + 3 * c, at, 3, slope);
    add_outer(taxels + size * size * t, own, size, own, size, weight);
    add_outer(contacts + 9 * c, at, 3, at, 3, weight);
    add_outer(common, all, shared, all, shared, weight);
    add_outer(taxel_common + size * shared * t, own, size, all, shared, weight);
    add_outer(contact_common + 3 * shared * c, at, 3, all, shared, weight);
    for (integer k = 0; k < 3 * size; k++) coupling[k] = weight * own[k / 3] * at[k % 3];
  }
}

/* What eliminating the contacts subtracts: B C^-1 B^T, from the diagonal blocks `own` of the taxels
   and from the blocks `off` of pairs. `order` lists the readings by contact, those of contact c
   from starts[c] on; block[p] is the block of the p-th pair of readings of one contact, its rows
   being those of the later reading. */
DECLARE void eliminate_contacts(integer contacts, integer size, const integer *starts,
                                const integer *order, const integer *block, const integer *taxel,
                                const double *coupling, const double *inverse, double *own,
                                double *off) {
  for (integer c = 0; c < contacts; c++)
    for (integer i = starts[c]; i < starts[c + 1]; i++) {
      const double *b = coupling + 3 * size * order[i], *v = inverse + 9 * c;
      double weighted[3 * MAX_SIZE];
      for (integer k = 0; k < size; k++)
        for (integer j = 0; j < 3; j++)
          weighted[3 * k + j] = b[3 * k] * v[j] + b[3 * k + 1] * v[3 + j] + b[3 * k + 2] * v[6 + j];
      for (integer j = i; j < starts[c + 1]; j++) {
        const double *a = coupling + 3 * size * order[j];
        double *to = i == j ? own + size * size * taxel[order[i]] : off + size * size * *block++;
        for (integer k = 0; k < size; k++)
          for (integer l = 0; l < size; l++)
            to[size * k + l] -= a[3 * k] * weighted[3 * l] + a[3 * k + 1] * weighted[3 * l + 1] +
                                a[3 * k + 2] * weighted[3 * l + 2];
      }
    }
}

/* out[owner[r]] (rows, columns) += A_r values[source[r]], values being (inner, columns); A_r
   (rows, inner) starts at a + r * stride, with the strides `down` and `across`. */
DECLARE void products(integer count, integer rows, integer inner, integer columns, const double *a,
                      integer stride, integer down, integer across, const integer *owner,
                      const integer *source, const double *values, double *out) {
  for (integer r = 0; r < count; r++, a += stride) {
    const double *restrict v = values + source[r] * inner * columns;
    double *restrict to = out + owner[r] * rows * columns;
    for (integer i = 0; i < rows; i++, to += columns) {
      const double *row = a + i * down;
      integer j = 0;
      for (; j + 3 <= inner; j += 3) { /* a contact's three values in one pass over the sums */
        double first = row[j * across], second = row[(j + 1) * across], third = row[(j + 2) * across];
        const double *p = v + j * columns, *q = p + columns, *s = q + columns;
        for (integer c = 0; c < columns; c++) to[c] = to[c] + first * p[c] + second * q[c] + third * s[c];
      }
      for (; j < inner; j++) add_scaled(to, v + j * columns, columns, row[j * across]);
    }
  }
}
