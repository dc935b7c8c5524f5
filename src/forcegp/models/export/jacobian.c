/* ---- Jacobians of the mean ---- */

int forcegp_jacobian(const double *q, const double *qd, const double *tau, const unsigned char *closed,
                     unsigned quantities, double *mean, double *jacobian) {
  double sine[NQ], cosine[NQ], shut[SOME(ROWS)], f[SOME(SUPPORTED)], slope[SOME(SLOPES)], out[SIZE_OF_ALL * 3 * NQ];
  const double *row = out;
  double hidden = 0.0;
  situation s;
  const int status = posterior(NULL, q, qd, tau, closed, quantities, 0, mean, NULL, NULL, &s);
  if (status) return status;
  for (int r = 0; r < ROWS; ++r) hidden += s.e.hidden[r][r]; /* not zero if closed contacts are not independent */
  if (hidden > HIDDEN || quantities & ~DIFFERENTIATED) return FORCEGP_NO_JACOBIAN;
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  for (int r = 0; r < ROWS; ++r) shut[r] = s.e.closed[r];
  all_slopes(&s.e, f, slope);
  slopes_of_mean(q, qd, tau, shut, f, slope, sine, cosine, out);
  for (int bit = 0; bit < QUANTITIES; ++bit) {
    const long size = 3 * NQ * SIZES[bit];
    if (quantities >> bit & 1u) memcpy(jacobian, row, sizeof(double) * size), jacobian += size;
    if (DIFFERENTIATED >> bit & 1u) row += size;
  }
  return 0;
}

int forcegp_jacobian_many(long count, const double *q, const double *qd, const double *tau, const unsigned char *closed,
                          unsigned quantities, double *mean, double *jacobian) {
  const int d = forcegp_size(quantities);
  int worst = 0;
  for (long i = 0; i < count; ++i) {
    const int status =
        forcegp_jacobian(q + i * NQ, qd + i * NQ, tau + i * NQ, closed ? closed + i * CONTACTS : NULL, quantities,
                         mean + i * d, jacobian + i * d * 3 * NQ);
    worst = worst ? worst : status;
  }
  return worst;
}
