
/* ---- learning online ----
 *
 * The covariance of the weights w of all functions is K^T K, with K lower triangular. Rows Phi w = y + noise of unit
 * variance change it to A'^-1 = (A + Phi^T Phi)^-1. Reflections that carry (X, p) to (X', 0), column by column p of
 * Phi K^T, keep K triangular: with g = X^-1 p and gamma^2 = 1 + g^T g, and (Y, c) of the same columns,
 *   c' = (c - Y g) / gamma,  Y' = Y + (c - Y g / (gamma + 1)) g^T / gamma.
 * In the end X X^T = I + Phi A^-1 Phi^T and Y X^T = A^-1 Phi^T, so w' = w + Y X^-1 (y - Phi w). */

enum { GROUP = NQ }; /* rows that are added at a time */

void forcegp_begin(forcegp_learned *s) {
  memset(s, 0, sizeof *s);
  for (int k = 0; k < COMPONENTS; ++k) {
    memcpy(s->weights + FUNCTION[k], WEIGHTS + FUNCTION[k], sizeof(double) * (FUNCTION[k + 1] - FUNCTION[k]));
    memcpy(s->folded + FOLDED[k], FOLDED_WEIGHTS[k], sizeof(double) * (FOLDED[k + 1] - FOLDED[k]));
    for (int i = FUNCTION[k]; i < FUNCTION[k + 1]; ++i)
      for (int j = i; j < RANK; ++j)
        s->root[(long)j * (j + 1) / 2 + i] = ROOTS[k][(long)(i - FUNCTION[k]) * (RANK - FUNCTION[k]) + j - FUNCTION[k]];
  }
}

/* weights of k(x, Z) and phi(x), from those of the whitened functions */
static void fold(forcegp_learned *s) {
  for (int k = 0; k < COMPONENTS; ++k) {
    const double *w = s->weights + FUNCTION[k];
    const int m = POINTS[k], features = FOLDED[k + 1] - FOLDED[k] - m, kept = FUNCTION[k + 1] - FUNCTION[k] - features;
    for (int i = 0; i < m; ++i) s->folded[FOLDED[k] + i] = dot(WHITENINGS[k] + (long)i * kept, w, kept);
    memcpy(s->folded + FOLDED[k] + m, w + kept, sizeof(double) * features);
  }
}

/* one group of rows, of which unused ones are zero; columns before `first` are zero in all */
static void learn_group(forcegp_learned *restrict s, double (*restrict Phi)[RANK], const double *restrict y, int first) {
  double Y[GROUP][RANK], X_inv[GROUP][GROUP], gain[GROUP];
  memset(Y, 0, sizeof Y);
  for (int k = 0; k < GROUP; ++k)
    for (int l = 0; l < GROUP; ++l) X_inv[k][l] = k == l ? 1.0 : 0.0;
  for (int j = first; j < RANK; ++j) {
    double *restrict c = s->root + (long)j * (j + 1) / 2;
    double g[GROUP], h[GROUP], p[GROUP], square = 0.0, gamma, a, b;
    for (int k = 0; k < GROUP; ++k) p[k] = dot(Phi[k] + first, c + first, j + 1 - first);
    for (int k = 0; k < GROUP; ++k) {
      g[k] = h[k] = 0.0;
      for (int l = 0; l < GROUP; ++l) g[k] += X_inv[k][l] * p[l];
      square += g[k] * g[k];
    }
    if (square == 0.0) continue;
    gamma = sqrt(1.0 + square), a = 1.0 / gamma, b = a / (gamma + 1.0);
    for (int i = 0; i <= j; ++i) {
      double Yg = 0.0, moved;
      for (int k = 0; k < GROUP; ++k) Yg += Y[k][i] * g[k];
      moved = a * c[i] - b * Yg, c[i] = a * (c[i] - Yg);
      for (int k = 0; k < GROUP; ++k) Y[k][i] += moved * g[k];
    }
    /* X' = X (I + g g^T / (gamma + 1)) */
    for (int k = 0; k < GROUP; ++k)
      for (int l = 0; l < GROUP; ++l) h[l] += g[k] * X_inv[k][l];
    for (int k = 0; k < GROUP; ++k)
      for (int l = 0; l < GROUP; ++l) X_inv[k][l] -= b * g[k] * h[l];
  }
  for (int k = 0; k < GROUP; ++k) {
    gain[k] = 0.0;
    for (int l = 0; l < GROUP; ++l) gain[k] += X_inv[k][l] * (y[l] - dot(Phi[l], s->weights, RANK));
  }
  for (int k = 0; k < GROUP; ++k)
    for (int i = 0; i < RANK; ++i) s->weights[i] += gain[k] * Y[k][i];
}

/* the columns R `(size, LEARNED)` of a sample: W, y - E[y], and a factor N of noise in units of the sensor's */
enum { INNOVATION = COMPONENTS, NOISE = COMPONENTS + 1, LEARNED = COMPONENTS + 1 + NQ };

/* rows without the directions that A qdd = b fixes; returns their number */
static int without_fixed(const equations *restrict e, const double *restrict std, double (*restrict R)[LEARNED]) {
#if CONTACTS > 0
  double U[ROWS * NQ], P[NQ * ROWS];
  for (int r = 0; r < ROWS; ++r)
    for (int j = 0; j < NQ; ++j) U[r * NQ + j] = e->A[r][j] * std[j];
  pseudo_inverse(U, P); /* makes the rows orthogonal */
  for (int done = 0; done < e->rank; ++done) {
    int most = done;
    double *u = U + done * NQ, size, square = 0.0;
    for (int r = done; r < ROWS; ++r)
      most = dot(U + r * NQ, U + r * NQ, NQ) > dot(U + most * NQ, U + most * NQ, NQ) ? r : most;
    for (int j = 0; j < NQ; ++j) {
      const double kept = u[j];
      u[j] = U[most * NQ + j], U[most * NQ + j] = kept;
    }
    /* a reflection of u to the axis `done`, of all that is left: that row is the fixed one */
    size = sqrt(dot(u + done, u + done, NQ - done));
    u[done] += u[done] < 0.0 ? -size : size;
    for (int j = done; j < NQ; ++j) square += u[j] * u[j];
    for (int c = 0; c < LEARNED; ++c) {
      double along = 0.0;
      for (int j = done; j < NQ; ++j) along += u[j] * R[j][c];
      for (int j = done; j < NQ; ++j) R[j][c] -= 2.0 * along / square * u[j];
    }
    for (int r = done + 1; r < ROWS; ++r) {
      const double along = dot(u + done, U + r * NQ + done, NQ - done);
      for (int j = done; j < NQ; ++j) U[r * NQ + j] -= 2.0 * along / square * u[j];
    }
  }
  memmove(R, R + e->rank, sizeof(double[LEARNED]) * (NQ - e->rank));
#else
  (void)std, (void)R;
#endif
  return NQ - e->rank;
}

/* rows over the factor C of I + N N^T = C C^T, by reflections of (I, N)^T, as squares would lose digits */
static void whiten(double (*restrict R)[LEARNED], int count) {
  double C[MOST_ROWS][MOST_ROWS]; /* C^T */
  for (int i = 0; i < count; ++i)
    for (int j = 0; j < count; ++j) C[i][j] = i == j ? 1.0 : 0.0;
  for (int j = 0; j < count; ++j) {
    double v[NQ], sum, norm = sqrt(C[j][j] * C[j][j] + dot(R[j] + NOISE, R[j] + NOISE, NQ));
    sum = C[j][j] + norm, C[j][j] = norm;
    for (int k = 0; k < NQ; ++k) v[k] = R[j][NOISE + k] / sum;
    for (int i = j + 1; i < count; ++i) {
      const double w = (C[j][i] + dot(v, R[i] + NOISE, NQ)) * sum / norm;
      C[j][i] = w - C[j][i];
      for (int k = 0; k < NQ; ++k) R[i][NOISE + k] -= v[k] * w;
    }
  }
  for (int i = 0; i < count; ++i) /* C^-1 (W, y) */
    for (int c = 0; c < NOISE; ++c) {
      for (int j = 0; j < i; ++j) R[i][c] -= C[j][i] * R[j][c];
      R[i][c] /= C[i][i];
    }
}

int forcegp_update(forcegp_learned *s, const double *q, const double *qd, const double *tau, const unsigned char *closed,
                   unsigned quantity, const double *measured, const double *noise) {
  equations e;
  latent f;
  affine z;
  double expected[NQ], gain[NQ * SOME(ROWS)], W[MOST_ROWS][COMPONENTS], R[MOST_ROWS][LEARNED], V[RANK], y[MOST_ROWS];
  double fastest = 0.0;
  int count, status, bit = 0;
  while (bit < QUANTITIES && quantity != 1u << bit) ++bit;
  if (bit == QUANTITIES || !(noise || NOISE_STD[bit])) return FORCEGP_NO_NOISE;
  noise = noise ? noise : NOISE_STD[bit];
  for (int i = 0; i < NQ; ++i) {
    if (!isfinite(q[i]) || !isfinite(qd[i]) || !isfinite(tau[i])) return FORCEGP_NOT_FINITE;
    fastest = fmax(fastest, fabs(qd[i]));
  }
  for (int a = 0; a < SIZES[bit]; ++a)
    if (!isfinite(measured[a]) || !(noise[a] > 0.0 && isfinite(noise[a]))) return FORCEGP_NOT_FINITE;
  if (fastest <= REST_SPEED) return FORCEGP_AT_REST;
  if (!assemble(q, qd, tau, closed, &e)) return FORCEGP_NO_INERTIA;
#if COULOMB > 0
  if (!friction_gain(&e, gain)) return FORCEGP_JAMMED;
#endif
  f.learned = s, f.functions = V;
  if ((status = latent_forces(q, qd, tau, &e, gain, 1, &f)) != 0) return status;
#ifdef PAYLOAD
  payload(q, qd, e.qdd, &f);
#endif
#ifdef INERTIAL
  inertial(q, qd, quantity == FORCEGP_QDD ? measured : e.qdd, &f);
#endif
  /* (W, y - E[y], N) / sigma with W = B E and N = B_Q Sigma_tau^1/2 */
  count = maps(&e, gain, quantity, &z);
  operators(&z, &f, count, W);
  expected_force(&e, tau, expected);
  memset(f.mean, 0, sizeof f.mean);
  read_mean(&z, &f, expected, count, y);
  for (int a = 0; a < count; ++a) {
    for (int k = 0; k < COMPONENTS; ++k) R[a][k] = W[a][k] / noise[a];
    R[a][INNOVATION] = (measured[a] - y[a]) / noise[a];
    for (int i = 0; i < NQ; ++i) {
      const double slow = qd[i] / STICK_SPEED[i], stick = STICK_VARIANCE[i] * exp(-slow * slow);
      R[a][NOISE + i] = z.B_Q[a][i] * sqrt(LEARNED_TORQUE_VARIANCE[i] + EXTERNAL_VARIANCE[i] + stick) / noise[a];
    }
  }
  if (quantity == FORCEGP_QDD) count = without_fixed(&e, noise, R);
  whiten(R, count);
  for (int start = 0; start < count; start += GROUP) {
    double Phi[GROUP][RANK], target[GROUP] = {0.0};
    memset(Phi, 0, sizeof Phi);
    for (int a = start; a < count && a < start + GROUP; ++a) {
      target[a - start] = TEMPERING * R[a][INNOVATION];
      for (int k = 0; k < COMPONENTS; ++k)
        for (int i = FUNCTION[k]; i < FUNCTION[k + 1]; ++i) Phi[a - start][i] = TEMPERING * R[a][k] * V[i];
    }
    learn_group(s, Phi, target, 0);
  }
  fold(s);
  return 0;
}

int forcegp_forget(forcegp_learned *s, double factor, int budget) {
  const double grown = 1.0 / sqrt(factor);
  if (!(factor > 0.0 && factor <= 1.0)) return FORCEGP_OUT_OF_RANGE;
  for (long i = 0; factor < 1.0 && i < (long)RANK * (RANK + 1) / 2; ++i) s->root[i] *= grown;
  for (int i = 0; i < RANK; ++i) s->faded[i] = 1.0 - factor * (1.0 - s->faded[i]);
  /* the prior is no sample: its precision of `budget` weights returns to one, of the others later */
  for (int done = 0; done < budget && done < RANK;) {
    double Phi[GROUP][RANK], target[GROUP] = {0.0};
    const int first = s->next;
    memset(Phi, 0, sizeof Phi);
    for (int k = 0; k < GROUP && done < budget && s->next < RANK; ++k, ++done, ++s->next) {
      Phi[k][s->next] = sqrt(s->faded[s->next]);
      s->faded[s->next] = 0.0;
    }
    learn_group(s, Phi, target, first);
    s->next %= RANK;
  }
  fold(s);
  return 0;
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
  fold(s);
  return 0;
}

int forcegp_predict_learned(const forcegp_learned *learned, long count, const double *q, const double *qd,
                            const double *tau, const unsigned char *closed, unsigned quantities, int noise, double *mean,
                            double *covariance, double *beyond) {
  return predict_all(learned, count, q, qd, tau, closed, quantities, noise, mean, covariance, beyond);
}
