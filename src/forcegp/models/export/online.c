/* ---- learning online ----
 *
 * The covariance of the weights w of all functions is K^T K, with K lower triangular. Rows Phi w = y + noise of unit
 * variance change it to A'^-1 = (A + Phi^T Phi)^-1. Reflections that carry (X, p) to (X', 0), column by column p of
 * Phi K^T, keep K triangular: with g = X^-1 p and gamma^2 = 1 + g^T g, and (Y, c) of the same columns,
 *   c' = (c - Y g) / gamma,  Y' = Y + (c - Y g / (gamma + 1)) g^T / gamma.
 * Finally, X X^T = noise + Phi A^-1 Phi^T and Y X^T = A^-1 Phi^T, so w' = w + Y X^-1 (y - Phi w). */

/* weights of k(x, Z) and phi(x), computed from those of the whitened functions. The last ones, errors of what the
 * robot includes, are zero: with K = (K_oo, 0; K_po, K_pp), the others then are w_o - K_po^T K_pp^-T w_p */
static int fold(forcegp_learned *s) {
  double given[RANK];
  memcpy(given, s->weights, sizeof given);
  for (int j = RANK - 1; j >= LEADING; --j) {
    const double *c = s->root + (long)j * (j + 1) / 2, z = given[j] / c[j];
    for (int i = 0; i <= j; ++i) given[i] -= z * c[i];
  }
  for (int k = 0; k < COMPONENTS; ++k) {
    const double *w = given + FUNCTION[k];
    const int m = POINTS[k], features = FOLDED[k + 1] - FOLDED[k] - m, kept = FUNCTION[k + 1] - FUNCTION[k] - features;
    for (int i = 0; i < m; ++i) s->folded[FOLDED[k] + i] = dot(WHITENINGS[k] + (long)i * kept, w, kept);
    memcpy(s->folded + FOLDED[k] + m, w + kept, sizeof(double) * features);
  }
  return 0;
}

void forcegp_begin(forcegp_learned *s) {
  memset(s, 0, sizeof *s);
  memcpy(s->weights, WEIGHTS, sizeof s->weights);
  for (int k = 0; k < COMPONENTS; ++k)
    for (int i = FUNCTION[k]; i < FUNCTION[k + 1]; ++i) {
      const double *row = INDEPENDENT[k] ? NULL : ROOTS[k] + (long)(i - FUNCTION[k]) * (WIDTH - START(k));
      if (INDEPENDENT[k]) s->root[(long)i * (i + 1) / 2 + i] = 1.0;
      for (int c = START(k); !INDEPENDENT[k] && c < COLUMNS; ++c) {
        const long j = COLUMN[c];
        if (j >= i) s->root[j * (j + 1) / 2 + i] = row[c - START(k)];
      }
    }
  fold(s);
}

/* X^-1 after X X^T has grown by p p^T, or without the direction p if that is `fixed`; g = X^-1 p. Returns gamma, or 0
 * if there is nothing to do */
static double grow(double (*restrict X_inv)[GROUP], const double *restrict p, int fixed, double *restrict g) {
  double h[GROUP], square = 0.0, size = 0.0, gamma, b;
  for (int k = 0; k < GROUP; ++k) {
    g[k] = dot(X_inv[k], p, GROUP), square += g[k] * g[k], size += p[k] * p[k];
  }
  if (square <= (fixed ? RANK_TOLERANCE * RANK_TOLERANCE * size : 0.0)) return 0.0;
  gamma = sqrt(1.0 + square), b = fixed ? 1.0 / square : 1.0 / (gamma * (gamma + 1.0));
  combine(&X_inv[0][0], g, GROUP, GROUP, h);
  for (int k = 0; k < GROUP; ++k)
    for (int l = 0; l < GROUP; ++l) X_inv[k][l] -= b * g[k] * h[l];
  return gamma;
}

/* rows whose noise has the covariance X X^T; unused rows, and columns before `first`, are zero */
static void learn_rows(forcegp_learned *restrict s, double (*restrict Phi)[RANK], const double *restrict y,
                       double (*restrict X_inv)[GROUP], int first) {
  double Y[GROUP][RANK] = {{0.0}}, gap[GROUP];
  for (int j = first; j < RANK; ++j) {
    double *restrict c = s->root + (long)j * (j + 1) / 2;
    double g[GROUP], p[GROUP], gamma, a, b;
    for (int k = 0; k < GROUP; ++k) p[k] = dot(Phi[k] + first, c + first, j + 1 - first);
    if ((gamma = grow(X_inv, p, 0, g)) == 0.0) continue;
    a = 1.0 / gamma, b = a / (gamma + 1.0);
    for (int i = 0; i <= j; ++i) {
      double Yg = 0.0, moved;
      for (int k = 0; k < GROUP; ++k) Yg += Y[k][i] * g[k];
      moved = a * c[i] - b * Yg, c[i] = a * (c[i] - Yg);
      for (int k = 0; k < GROUP; ++k) Y[k][i] += moved * g[k];
    }
  }
  for (int k = 0; k < GROUP; ++k) gap[k] = y[k] - dot(Phi[k], s->weights, RANK);
  for (int k = 0; k < GROUP; ++k) {
    const double gain = dot(X_inv[k], gap, GROUP);
    for (int i = 0; i < RANK; ++i) s->weights[i] += gain * Y[k][i];
  }
}

int forcegp_update(forcegp_learned *s, const double *q, const double *qd, const double *tau, const unsigned char *closed,
                   unsigned quantity, const double *measured, const double *noise) {
  equations e;
  latent f;
  affine z;
  double expected[NQ], gain[NQ * SOME(ROWS)], W[COMPONENTS * SIZE_OF_ALL], Phi[GROUP][RANK] = {{0.0}};
  double y[GROUP] = {0.0}, std[GROUP], X_inv[GROUP][GROUP] = {{0.0}}, p[GROUP] = {0.0}, g[GROUP], fastest = 0.0;
  int size, status, bit = 0;
  while (bit < QUANTITIES && quantity != 1u << bit) ++bit;
  if (bit == QUANTITIES || !(noise || SENSOR_VARIANCE[bit])) return FORCEGP_NO_NOISE;
  for (int i = 0; i < NQ; ++i) fastest = fmax(fastest, fabs(qd[i]));
  for (int a = 0; a < SIZES[bit]; ++a) {
    std[a] = noise ? noise[a] : sqrt(SENSOR_VARIANCE[bit][a]);
    if (!isfinite(measured[a]) || !(std[a] > 0.0 && isfinite(std[a]))) return FORCEGP_NOT_FINITE;
  }
  if ((status = prepare(q, qd, tau, closed, &e, gain)) != 0) return status;
  if (fastest <= REST_SPEED) return FORCEGP_AT_REST;
  f.learned = s, f.folded = s->folded;
  if ((status = latent_forces(q, qd, tau, &e, gain, 1, &f)) != 0) return status;
  inertial_errors(q, qd, tau, &e, quantity == FORCEGP_QDD ? measured : NULL, &f);
  /* rows (W V^T, y - E[y]) / sigma with W = B E, of noise (1 + N N^T) / kappa with N = B_Q Sigma_tau^1/2 / sigma */
  size = maps(&e, gain, quantity, &z);
  operators(&z, &f, size, W);
  expected_force(&e, tau, expected);
  memset(f.mean, 0, sizeof f.mean);
  read_mean(&z, &f, expected, size, y);
  for (int a = 0; a < size; ++a) {
    y[a] = (measured[a] - y[a]) / std[a];
    for (int k = 0; k < COMPONENTS; ++k)
      for (int i = FUNCTION[k]; i < FUNCTION[k + 1]; ++i) Phi[a][i] = W[k * size + a] / std[a] * f.V[i];
  }
  for (int k = 0; k < GROUP; ++k) X_inv[k][k] = TEMPERING;
  for (int r = 0; quantity == FORCEGP_QDD && r < ROWS; ++r) { /* A qdd = b fixes these directions */
    for (int a = 0; a < size; ++a) p[a] = e.A[r][a] * std[a];
    grow(X_inv, p, 1, g);
  }
  for (int i = 0; i < NQ; ++i) {
    const double slow = qd[i] / STICK_SPEED[i], stick = STICK_VARIANCE[i] * exp(-slow * slow);
    const double torque = sqrt(LEARNED_TORQUE_VARIANCE[i] + EXTERNAL_VARIANCE[i] + stick);
    for (int a = 0; a < size; ++a) p[a] = z.B_Q[a][i] * torque / std[a] / TEMPERING;
    grow(X_inv, p, 0, g);
  }
  for (int k = 0; k < 3 * CONTACTS; ++k) {
    contact_unknown(&z, &e, k / 3, k % 3, size, p);
    for (int a = 0; a < size; ++a) p[a] /= std[a] * TEMPERING;
    grow(X_inv, p, 0, g);
  }
  for (int k = 0; k < GROUP; ++k)
    if (!isfinite(dot(Phi[k], Phi[k], RANK) + y[k] * y[k])) return FORCEGP_OVERFLOW;
  learn_rows(s, Phi, y, X_inv, 0);
  for (int r = 0; r < ROWS; ++r)
    if (e.closed[r]) s->touched[r] = 1.0;
  return fold(s);
}

int forcegp_forget(forcegp_learned *s, double factor, int budget) {
  if (!(factor > 0.0 && factor <= 1.0)) return FORCEGP_OUT_OF_RANGE;
  for (long i = 0; factor < 1.0 && i < (long)RANK * (RANK + 1) / 2; ++i) s->root[i] /= sqrt(factor);
  for (int i = 0; i < RANK; ++i) s->faded[i] = 1.0 - factor * (1.0 - s->faded[i]);
  /* the prior must not fade: its precision returns to one, now for `budget` weights, for the others later */
  for (int done = 0; done < budget && done < RANK;) {
    double Phi[GROUP][RANK] = {{0.0}}, zero[GROUP] = {0.0}, X_inv[GROUP][GROUP] = {{0.0}};
    const int first = s->next;
    for (int k = 0; k < GROUP && done < budget && s->next < RANK; ++k, ++done, ++s->next)
      Phi[k][s->next] = sqrt(s->faded[s->next]), s->faded[s->next] = 0.0, X_inv[k][k] = 1.0;
    learn_rows(s, Phi, zero, X_inv, first);
    s->next %= RANK;
  }
  return fold(s);
}

int forcegp_drift(forcegp_learned *s, int prior, double factor) {
  if (prior < 0 || prior >= PRIOR_COUNT || !(factor >= 0.0 && factor <= 1.0)) return FORCEGP_OUT_OF_RANGE;
  /* w' = rho w + sqrt(1 - rho^2) xi of the weights of one prior, so that Cov' = F Cov F^T + (1 - rho^2) I */
  for (int i = FUNCTION[FIRST_COMPONENT[prior]]; i < FUNCTION[FIRST_COMPONENT[prior + 1]]; ++i) {
    double x[RANK] = {0.0};
    s->weights[i] *= factor;
    for (long j = i; j < RANK; ++j) s->root[j * (j + 1) / 2 + i] *= factor;
    x[i] = sqrt(1.0 - factor * factor);
    for (long j = i; j >= 0; --j) { /* a rotation of column j and x that makes x_j zero */
      double *restrict c = s->root + j * (j + 1) / 2;
      const double size = hypot(c[j], x[j]), cosine = c[j] / size, sine = x[j] / size;
      if (x[j] == 0.0) continue;
      for (long l = 0; l <= j; ++l) {
        const double t = c[l];
        c[l] = cosine * t + sine * x[l], x[l] = cosine * x[l] - sine * t;
      }
    }
  }
  return fold(s);
}
