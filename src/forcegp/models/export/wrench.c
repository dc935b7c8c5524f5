/* ---- the external wrench w, from accelerations ----
 *
 * r = M qdd - E Q = J^T w + e with the prior w ~ N(0, W) and the covariance S = Cov e of the forces, the measured torques
 * and qdd. By generalized least squares, Cov w = (J S^-1 J^T + W^-1)^-1 and E w = Cov w J S^-1 r. Multipliers of contacts
 * are additional unknowns, with rows of A in J. Since moments may be small compared with forces, the result is a mixture
 * of estimates with priors `LEVERS` times as wide, weighted by their evidence. */

enum { UNKNOWNS = FORCEGP_WRENCH + ROWS };

/* K = G^-1 and V = K^T K = M^-1, with the lower Cholesky factor G of M = G G^T; 0 unless M is positive definite */
static int inverse(const double *restrict M, int n, double *restrict K, double *restrict V) {
  double G[MOST_UNKNOWNS * MOST_UNKNOWNS];
  if (!inverse_factor(M, n, G, K)) return 0;
  for (int i = 0; i < n; ++i)
    for (int j = 0; j < n; ++j) {
      V[i * n + j] = 0.0;
      for (int k = i > j ? i : j; k < n; ++k) V[i * n + j] += K[k * n + i] * K[k * n + j];
    }
  return 1;
}

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

static int estimate(const forcegp_learned *learned, const double *q, const double *qd, const double *tau, const double *qdd,
                    const unsigned char *closed, const double *qdd_std, double *mean, double *covariance, double *beyond) {
  enum { K = FORCEGP_WRENCH };
  situation s;
  affine z;
  double force[NQ], r[NQ], S[NQ * NQ], unknown[NQ], zero[NQ] = {0.0}, G[NQ * NQ], root[NQ * NQ], sine[NQ], cosine[NQ];
  double J[UNKNOWNS * NQ], B[UNKNOWNS][NQ], pull[UNKNOWNS], precision[UNKNOWNS * UNKNOWNS], V[UNKNOWNS * UNKNOWNS];
  double V_root[UNKNOWNS * UNKNOWNS], m[K], C[K * K];
  int status;
  for (int i = 0; i < NQ; ++i)
    if (!isfinite(qdd[i]) || (qdd_std && !(qdd_std[i] >= 0.0 && isfinite(qdd_std[i])))) return FORCEGP_NOT_FINITE;
  if ((status = evaluate(learned, q, qd, tau, closed, qdd, 1, &s)) != 0) return status;
  if (beyond) memcpy(beyond, s.far, sizeof s.far);
  maps(&s.e, s.gain, FORCEGP_TOTAL_FORCE, &z);
  read_mean(&z, &s.f, s.prior_mean, NQ, force);
  if (!read_covariance(&z, &s.e, &s.f, zero, NQ, S)) return FORCEGP_UNRESOLVED;
  unknown_forces(qd, s.far, 1, unknown);
  for (int i = 0; i < NQ; ++i) {
    r[i] = dot(s.e.M[i], qdd, NQ) - force[i], S[i * NQ + i] += unknown[i];
    for (int k = 0; k < NQ; ++k) {
      const double variance = qdd_std ? qdd_std[k] * qdd_std[k] : SENSOR_VARIANCE[0] ? SENSOR_VARIANCE[0][k] : 0.0;
      for (int j = 0; j < NQ; ++j) S[i * NQ + j] += s.e.M[i][k] * variance * s.e.M[j][k];
    }
  }
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  wrench_jacobian(q, sine, cosine, J);
  if (ROWS > 0) memcpy(J + K * NQ, s.e.A, sizeof(double) * ROWS * NQ);
  /* with S = L L^T and w = W^1/2 v: E v = (B B^T + 1)^-1 B L^-1 r, B = W^1/2 J L^-T */
  if (!inverse_factor(S, NQ, G, root)) return FORCEGP_UNRESOLVED;
  for (int i = 0; i < NQ; ++i) zero[i] = dot(root + i * NQ, r, i + 1);
  for (int a = 0; a < UNKNOWNS; ++a)
    for (int i = 0; i < NQ; ++i) B[a][i] = WRENCH_PRIOR[a] * dot(root + i * NQ, J + a * NQ, i + 1);
  for (int a = 0; a < UNKNOWNS; ++a) {
    pull[a] = dot(B[a], zero, NQ);
    for (int b = 0; b < UNKNOWNS; ++b) precision[a * UNKNOWNS + b] = dot(B[a], B[b], NQ) + (a == b ? 1.0 : 0.0);
  }
  if (!inverse(precision, UNKNOWNS, V_root, V)) return FORCEGP_UNRESOLVED;
  for (int a = 0; a < K; ++a) m[a] = dot(V + a * UNKNOWNS, pull, UNKNOWNS), memcpy(C + a * K, V + a * UNKNOWNS, sizeof m);
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
    int status = estimate(learned, given[0], given[1], given[2], given[3], shut, qdd_std, mean + n * K,
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
        status = estimate(learned, x[0], x[1], x[2], x[3], shut, qdd_std, w, NULL, NULL);
        for (int a = 0; a < K; ++a) column[a * 4 * NQ] += weight[t] / step * w[a];
      }
    }
    worst = worst ? worst : status;
  }
  return worst;
}
