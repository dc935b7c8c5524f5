/* ---- unknown forces w, from accelerations ----
 *
 * r = M qdd - E Q = J^T w + e with the prior w ~ N(0, W) and the covariance S = Cov e of the forces, the measured torques
 * and qdd. By generalized least squares, Cov w = (J S^-1 J^T + W^-1)^-1 and E w = Cov w J S^-1 r. */

/* equations of motion and posterior of the forces at a state with measured accelerations */
static int measured(const forcegp_learned *learned, const double *q, const double *qd, const double *tau, const double *qdd,
                    const unsigned char *closed, const double *qdd_std, double *beyond, situation *s) {
  int status;
  for (int i = 0; i < NQ; ++i)
    if (!isfinite(qdd[i]) || (qdd_std && !(qdd_std[i] >= 0.0 && isfinite(qdd_std[i])))) return FORCEGP_NOT_FINITE;
  if ((status = evaluate(learned, q, qd, tau, closed, qdd, 1, s)) != 0) return status;
  if (beyond) memcpy(beyond, s->far, sizeof s->far);
  return 0;
}

/* mean m and covariance V of w = prior v in units of the prior, given the mean of the forces, their covariance S, and n
 * rows of J. With S = L L^T, E v = (B B^T + 1)^-1 B L^-1 r with B = prior J L^-T */
static int least_squares(const situation *s, const double *qd, const double *qdd, const double *qdd_std,
                         const double *restrict force, const double *restrict S, int n, double (*restrict J)[NQ],
                         const double *restrict prior, double *restrict m, double *restrict V) {
  const int width = NQ + n + 1;
  double unknown[NQ], U[NQ * (NQ + UNKNOWNS + 1)], precision[UNKNOWNS * UNKNOWNS], pull[UNKNOWNS], V_root[UNKNOWNS * UNKNOWNS];
  unknown_forces(qd, s->far, 1, unknown);
  for (int i = 0; i < NQ; ++i) { /* [S, J^T prior, r] */
    double *row = U + i * width, by_noise[NQ];
    for (int k = 0; k < NQ; ++k) {
      const double variance = qdd_std ? qdd_std[k] * qdd_std[k] : SENSOR_VARIANCE[0] ? SENSOR_VARIANCE[0][k] : 0.0;
      by_noise[k] = s->e.M[i][k] * variance;
    }
    combine(&s->e.M[0][0], by_noise, NQ, NQ, row);
    for (int j = 0; j < NQ; ++j) row[j] += S[i * NQ + j];
    row[i] += unknown[i];
    for (int a = 0; a < n; ++a) row[NQ + a] = prior[a] * J[a][i];
    row[NQ + n] = dot(s->e.M[i], qdd, NQ) - force[i];
  }
  if (!eliminate(U, NQ, width)) return 0;
  for (int a = 0; a < n; ++a) { /* rows of [B B^T, B L^-1 r] from the diagonal on */
    double sums[UNKNOWNS + 1] = {0.0};
    for (int k = 0; k < NQ; ++k) {
      const double *B = U + k * width + NQ, share = B[a];
      for (int b = a; b <= n; ++b) sums[b] += share * B[b];
    }
    for (int b = a; b < n; ++b) precision[a * n + b] = sums[b] + (a == b ? 1.0 : 0.0);
    pull[a] = sums[n];
  }
  if (!inverse(precision, n, V_root, V)) return 0;
  for (int a = 0; a < n; ++a) m[a] = dot(V + a * n, pull, n);
  return 1;
}

#ifdef FORCEGP_WRENCH
/* ---- the external wrench; multipliers of contacts are additional unknowns, with rows of A in J. Since moments may be small
 * compared with forces, the result is a mixture of estimates with priors `LEVERS` times as wide, weighted by their
 * evidence. ---- */

/* mean and covariance C of the mixture, in units of the prior, given those for the widest prior: C_s^-1 = C^-1 + s^-2 - 1,
 * m_s = C_s C^-1 m, weights |C_s|^1/2 / s exp(m_s^T C_s^-1 m_s / 2) */
static int over_levers(double *restrict mean, double *restrict C) {
  enum { K = FORCEGP_WRENCH };
  double precision[K * K], root[K * K], pull[K], m[LEVER_COUNT][K], C_s[LEVER_COUNT][K * K], weight[LEVER_COUNT];
  double most, total = 0.0;
  if (!inverse(C, K, root, precision)) return 0;
  for (int i = 0; i < K; ++i) pull[i] = dot(precision + i * K, mean, K);
  for (int s = 0; s < LEVER_COUNT; ++s) {
    double narrow[K * K];
    memcpy(narrow, precision, sizeof narrow);
    for (int i = 0; i < K; ++i) narrow[i * K + i] += 1.0 / (LEVERS[s][i] * LEVERS[s][i]) - 1.0;
    if (!inverse(narrow, K, root, C_s[s])) return 0;
    for (int i = 0; i < K; ++i) m[s][i] = dot(C_s[s] + i * K, pull, K);
    weight[s] = 0.5 * dot(m[s], pull, K);
    for (int i = 0; i < K; ++i) weight[s] += log(root[i * K + i]) - log(LEVERS[s][i]);
  }
  most = weight[0];
  for (int s = 0; s < LEVER_COUNT; ++s) most = fmax(most, weight[s]);
  for (int s = 0; s < LEVER_COUNT; ++s) weight[s] = exp(weight[s] - most), total += weight[s];
  memset(mean, 0, sizeof(double) * K), memset(C, 0, sizeof(double) * K * K);
  for (int s = 0; s < LEVER_COUNT; ++s)
    for (int i = 0; i < K; ++i) mean[i] += weight[s] / total * m[s][i];
  for (int s = 0; s < LEVER_COUNT; ++s)
    for (int i = 0; i < K; ++i)
      for (int j = 0; j < K; ++j)
        C[i * K + j] += weight[s] / total * (C_s[s][i * K + j] + (m[s][i] - mean[i]) * (m[s][j] - mean[j]));
  return 1;
}

static int external_wrench(const forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                           const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                           double *covariance, double *beyond) {
  enum { K = FORCEGP_WRENCH, N = K + ROWS };
  situation s;
  affine z;
  double force[NQ], S[NQ * NQ], zero[NQ] = {0.0}, sine[NQ], cosine[NQ], J[N][NQ], m[N], V[N * N], C[K * K];
  int status = measured(learned, q, qd, tau, qdd, closed, qdd_std, beyond, &s);
  if (status) return status;
  maps(&s.e, s.gain, FORCEGP_TOTAL_FORCE, &z);
  read_mean(&z, &s.f, s.prior_mean, NQ, force);
  if (!read_covariance(&z, &s.e, &s.f, zero, NQ, S)) return FORCEGP_UNRESOLVED;
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  wrench_jacobian(q, sine, cosine, J[0]);
  if (ROWS > 0) memcpy(J[K], s.e.A, sizeof(double) * ROWS * NQ);
  if (!least_squares(&s, qd, qdd, qdd_std, force, S, N, J, WRENCH_PRIOR, m, V)) return FORCEGP_UNRESOLVED;
  for (int a = 0; a < K; ++a) memcpy(C + a * K, V + a * N, sizeof(double) * K);
  if (!over_levers(m, C)) return FORCEGP_UNRESOLVED;
  for (int a = 0; a < K; ++a) {
    mean[a] = WRENCH_PRIOR[a] * m[a];
    for (int b = 0; covariance && b < K; ++b) covariance[a * K + b] = WRENCH_PRIOR[a] * WRENCH_PRIOR[b] * C[a * K + b];
  }
  return all_finite(mean, K) && (!covariance || all_finite(covariance, K * K)) ? 0 : FORCEGP_OVERFLOW;
}

int forcegp_external_wrench(const forcegp_learned *learned, long count, const double *q, const double *qd, const double *tau,
                            const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                            double *covariance, double *beyond, double *jacobian) {
  enum { K = FORCEGP_WRENCH };
  int worst = 0;
  for (long n = 0; n < count; ++n) {
    const unsigned char *shut = closed ? closed + n * CONTACTS : NULL;
    const double *given[4] = {q + n * NQ, qd + n * NQ, tau + n * NQ, qdd + n * NQ};
    int status = external_wrench(learned, given[0], given[1], given[2], given[3], shut, qdd_std, mean + n * K,
                          covariance ? covariance + n * K * K : NULL, beyond ? beyond + n * NQ : NULL);
    for (int c = 0; jacobian && !status && c < 4 * NQ; ++c) { /* fourth-order differences */
      static const double times[4] = {-2.0, -1.0, 1.0, 2.0}, weight[4] = {1.0 / 12.0, -2.0 / 3.0, 2.0 / 3.0, -1.0 / 12.0};
      const double step = c < 2 * NQ ? STATE_STEP : FORCE_STEP;
      double *column = jacobian + n * K * 4 * NQ + c;
      for (int a = 0; a < K; ++a) column[a * 4 * NQ] = 0.0;
      for (int t = 0; t < 4 && !status; ++t) {
        double x[4][NQ], w[K];
        for (int i = 0; i < 4; ++i) memcpy(x[i], given[i], sizeof x[i]);
        x[c / NQ][c % NQ] += times[t] * step;
        status = external_wrench(learned, x[0], x[1], x[2], x[3], shut, qdd_std, w, NULL, NULL);
        for (int a = 0; a < K; ++a) column[a * 4 * NQ] += weight[t] / step * w[a];
      }
    }
    worst = worst ? worst : status;
  }
  return worst;
}
#endif

#if CONTACTS > 0
/* ---- the forces F = lambda (n - mu s(v)) + F_z + u of closed contacts, with w = (lambda, y) and F_z + u = mean + t R y.
 * Learned friction F_z belongs to the unknown forces here, not to those in S. ---- */

/* eigenvalues d and the first eigenvector (c, s) of a symmetric 2 x 2 matrix by a Jacobi rotation; the second is (-s, c) */
static void axes_of(const double *restrict C, double *restrict d, double *restrict c, double *restrict s) {
  const double zeta = (C[0] - C[3]) / (2.0 * C[2]);
  const double t = C[2] == 0.0 ? 0.0 : (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
  *c = 1.0 / sqrt(1.0 + t * t), *s = *c * t;
  d[0] = C[0] + t * C[2], d[1] = C[3] - t * C[2];
}

/* W = P B E for the friction of a contact, which maps latent forces to F_z = t P B Q_z: B = t^T J and P = (B B^T)^+ */
static void friction_of_contact(const situation *s, int contact, double (*restrict W)[2 * CONTACTS]) {
  const touching *at = &s->e.contact[contact];
  double B[2][NQ], C[4], d[2], c, e, P[2][2];
  for (int t = 0; t < 2; ++t)
    for (int j = 0; j < NQ; ++j) {
      B[t][j] = 0.0;
      for (int x = 0; x < 3; ++x) B[t][j] += at->tangent[t][x] * at->jacobian[x][j];
    }
  C[0] = dot(B[0], B[0], NQ), C[2] = dot(B[1], B[0], NQ), C[3] = dot(B[1], B[1], NQ);
  axes_of(C, d, &c, &e);
  for (int t = 0; t < 2; ++t) d[t] = d[t] > RANK_TOLERANCE * RANK_TOLERANCE * (C[0] + C[3]) ? 1.0 / d[t] : 0.0;
  P[0][0] = c * c * d[0] + e * e * d[1], P[1][1] = e * e * d[0] + c * c * d[1], P[0][1] = P[1][0] = c * e * (d[0] - d[1]);
  for (int k = 0; k < COMPONENTS; ++k) {
    double pull[2];
    if (OWNER[k] != contact) continue;
    for (int t = 0; t < 2; ++t) pull[t] = dot(B[t], s->f.E[k], NQ);
    for (int t = 0; t < 2; ++t) W[k][2 * contact + t] = P[t][0] * pull[0] + P[t][1] * pull[1];
  }
}

/* m and D `(3, 3)` of the force F = m + D w of a contact, given the mean y and the covariance `friction` of F_z */
static void force_of_contact(const situation *s, int contact, const double *restrict y, const double *restrict friction,
                             double *restrict m, double (*restrict D)[3]) {
  enum { N = 2 * CONTACTS };
  const touching *at = &s->e.contact[contact];
  const double variance = tip_variance(&s->e, contact);
  double C[4] = {friction[0] + variance, 0.0, friction[N], friction[N + 1] + variance}, d[2], c, e;
  axes_of(C, d, &c, &e);
  for (int t = 0; t < 2; ++t) d[t] = sqrt(d[t] > LEAST_VARIANCE ? d[t] : LEAST_VARIANCE);
  for (int x = 0; x < 3; ++x) {
    const double t = at->tangent[0][x], u = at->tangent[1][x];
    m[x] = t * y[0] + u * y[1], D[x][0] = at->normal[x];
    D[x][1] = (t * c + u * e) * d[0], D[x][2] = (u * c - t * e) * d[1];
  }
#if COULOMB > 0
  for (int f = 0; f < COULOMB; ++f) {
    const double size = sqrt(dot(at->sliding, at->sliding, 3) + COULOMB_SMOOTHING[f] * COULOMB_SMOOTHING[f]);
    for (int x = 0; COULOMB_CONTACT[f] == contact && x < 3; ++x) D[x][0] -= COULOMB_COEFFICIENT[f] * at->sliding[x] / size;
  }
#endif
}

static int contact_force(const forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                         const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                         double *covariance, double *beyond) {
  enum { K = 3 * CONTACTS };
  situation s;
  double force[NQ], S[NQ * NQ], W[COMPONENTS][2 * CONTACTS], friction[4 * CONTACTS * CONTACTS], y[2 * CONTACTS] = {0.0};
  double D[CONTACTS][3][3], J[K][NQ], prior[K], m[K], V[K * K];
  int order[CONTACTS], n = 0, status = measured(learned, q, qd, tau, qdd, closed, qdd_std, beyond, &s);
  if (status) return status;
  memset(W, 0, sizeof W);
  for (int c = 0; c < CONTACTS; ++c)
    if (s.e.closed[c]) friction_of_contact(&s, c, W);
  learned_covariance(&s.f, W[0], 2 * CONTACTS, friction);
  memcpy(force, s.prior_mean, sizeof force);
  for (int k = 0; k < COMPONENTS; ++k) {
    for (int t = 0; OWNER[k] >= 0 && t < 2; ++t) y[2 * OWNER[k] + t] += W[k][2 * OWNER[k] + t] * s.f.mean[k];
    if (OWNER[k] >= 0) memset(s.f.E[k], 0, sizeof s.f.E[k]);
    for (int j = 0; s.f.mean[k] != 0.0 && j < NQ; ++j) force[j] += s.f.E[k][j] * s.f.mean[k];
  }
  if (!learned_covariance(&s.f, s.f.E[0], NQ, S)) return FORCEGP_UNRESOLVED;
  mirror(S, NQ);
  memset(mean, 0, sizeof(double) * K);
  if (covariance) memset(covariance, 0, sizeof(double) * K * K);
  for (int c = 0; c < CONTACTS; ++c) {
    const touching *at = &s.e.contact[c];
    if (!s.e.closed[c]) continue;
    force_of_contact(&s, c, y + 2 * c, friction + 2 * c * (2 * CONTACTS + 1), mean + 3 * c, D[n]);
    for (int j = 0; j < NQ; ++j)
      for (int x = 0; x < 3; ++x) force[j] += at->jacobian[x][j] * mean[3 * c + x];
    for (int i = 0; i < 3; ++i) { /* rows of D^T J */
      prior[3 * n + i] = i ? 1.0 : NORMAL_STD;
      for (int j = 0; j < NQ; ++j) J[3 * n + i][j] = 0.0;
      for (int x = 0; x < 3; ++x)
        for (int j = 0; j < NQ; ++j) J[3 * n + i][j] += D[n][x][i] * at->jacobian[x][j];
    }
    order[n++] = c;
  }
  if (!least_squares(&s, qd, qdd, qdd_std, force, S, 3 * n, J, prior, m, V)) return FORCEGP_UNRESOLVED;
  for (int k = 0; k < n; ++k) /* F = m + D prior v */
    for (int x = 0; x < 3; ++x) {
      double along[K] = {0.0}, D_prior[3];
      for (int i = 0; i < 3; ++i) D_prior[i] = D[k][x][i] * prior[3 * k + i];
      mean[3 * order[k] + x] += dot(D_prior, m + 3 * k, 3);
      if (!covariance) continue;
      for (int i = 0; i < 3; ++i)
        for (int b = 0; b < 3 * n; ++b) along[b] += D_prior[i] * V[3 * (3 * k + i) * n + b] * prior[b];
      for (int l = 0; l < n; ++l)
        for (int i = 0; i < 3; ++i) covariance[(3 * order[k] + x) * K + 3 * order[l] + i] = dot(D[l][i], along + 3 * l, 3);
    }
  return all_finite(mean, K) && (!covariance || all_finite(covariance, K * K)) ? 0 : FORCEGP_OVERFLOW;
}

int forcegp_contact_force(const forcegp_learned *learned, long count, const double *q, const double *qd, const double *tau,
                          const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                          double *covariance, double *beyond) {
  enum { K = 3 * CONTACTS };
  int worst = 0;
  for (long n = 0; n < count; ++n) {
    const int status = contact_force(learned, q + n * NQ, qd + n * NQ, tau + n * NQ, qdd + n * NQ,
                                     closed ? closed + n * CONTACTS : NULL, qdd_std, mean + n * K,
                                     covariance ? covariance + n * K * K : NULL, beyond ? beyond + n * NQ : NULL);
    worst = worst ? worst : status;
  }
  return worst;
}
#endif
