/* ---- sums of products, each computed as eight partial sums so that compilers use vector registers ---- */

static double dot(const double *restrict a, const double *restrict b, int n) {
  double lanes[8] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0}, sum = 0.0;
  int i = 0;
  for (; i + 8 <= n; i += 8)
    for (int lane = 0; lane < 8; ++lane) lanes[lane] += a[i + lane] * b[i + lane];
  for (; i < n; ++i) sum += a[i] * b[i];
  for (int half = 4; half > 0; half /= 2)
    for (int lane = 0; lane < half; ++lane) lanes[lane] += lanes[lane + half];
  return sum + lanes[0];
}

/* y = x^T C for C with n rows and m columns */
static void combine(const double *restrict C, const double *restrict x, int n, int m, double *restrict y) {
  int i = 0;
  for (int c = 0; c < m; ++c) y[c] = 0.0;
  for (; i + 4 <= n; i += 4) {
    const double *restrict row = C + (long)i * m;
    const double x0 = x[i], x1 = x[i + 1], x2 = x[i + 2], x3 = x[i + 3];
    for (int c = 0; c < m; ++c)
      y[c] += x0 * row[c] + x1 * row[m + c] + x2 * row[2 * (long)m + c] + x3 * row[3 * (long)m + c];
  }
  for (; i < n; ++i)
    for (int c = 0; c < m; ++c) y[c] += x[i] * C[(long)i * m + c];
}

/* ---- the constrained equations of motion, M qdd = Q + Q_z + A^T lambda and A qdd = b ---- */

typedef struct {
  double position[3], velocity[3], jacobian[3][NQ]; /* of the material contact point */
  double normal[3], tangent[2][3];                  /* of the surface at this point */
  double sliding[3], sliding_jacobian[3][NQ];       /* velocity and Jacobian along the surface */
  double turning[NQ];                               /* n^T J_omega */
  double A[NQ], b, c;                               /* A qdd = b while the contact is closed; c is its error */
} touching;

typedef struct {
  double M[NQ][NQ], Q_C[NQ], Q_G[NQ], Q_D[NQ]; /* mass matrix; bias, gravity and damping force */
  double A[SOME(ROWS)][NQ], b[SOME(ROWS)];     /* rows of open contacts are zero */
  double M_inv[NQ][NQ], H[NQ][NQ];             /* H = M^-1 - L A M^-1 maps forces to accelerations */
  double L[NQ][SOME(ROWS)];                    /* L = M^-1 A^T (A M^-1 A^T)^+ */
  double S[SOME(ROWS)][SOME(ROWS)];            /* (A M^-1 A^T)^+ */
  double hidden[SOME(ROWS)][SOME(ROWS)];       /* projector on multipliers that move nothing, A^T mu = 0 */
  double qdd[NQ], load[SOME(ROWS)];            /* qdd and lambda of the analytical forces */
  int closed[SOME(CONTACTS)];
  touching contact[SOME(CONTACTS)];
  double x[SOME(INPUTS)], phi[SOME(FEATURES)]; /* standardized inputs and features of the priors */
  double expected[NQ];                         /* force that learned terms are expected to have */
  double pressing[SOME(ROWS)];                 /* lambda that multiplies errors of friction coefficients */
} equations;

/* [M, R] becomes [G^T, G^-1 R], with the lower Cholesky factor G of M = G G^T `(n, n)`, in rows of `width` numbers; returns 0
 * unless M is positive definite. Only the upper triangle of M is read. Loops run along rows, so that compilers use vector
 * registers */
static int eliminate(double *U, int n, int width) {
  for (int k = 0; k < n; ++k) {
    double *restrict pivot = U + k * width;
    const double inverse_size = 1.0 / sqrt(pivot[k]);
    if (!(pivot[k] > 0.0)) return 0;
    for (int j = k; j < width; ++j) pivot[j] *= inverse_size;
    for (int i = k + 1; i < n; ++i) {
      double *restrict below = U + i * width;
      const double share = pivot[i];
      for (int j = i; j < width; ++j) below[j] -= share * pivot[j];
    }
  }
  return 1;
}

/* K = G^-1 `(n, n)` with the lower Cholesky factor G of M = G G^T, and V = K^T K = M^-1 unless it is NULL; returns 0 unless M
 * is positive definite */
static int inverse(const double *restrict M, int n, double *restrict K, double *restrict V) {
  double U[MOST_UNKNOWNS * MOST_UNKNOWNS]; /* G^T */
  memcpy(U, M, sizeof(double) * n * n);
  if (!eliminate(U, n, n)) return 0;
  /* row k of K = (1 - sum of G_ki K_i) / G_kk */
  for (int k = 0; k < n; ++k) {
    double *restrict row = K + k * n;
    const double inverse_size = 1.0 / U[k * n + k];
    for (int j = 0; j < n; ++j) row[j] = j == k ? 1.0 : 0.0;
    for (int i = 0; i < k; ++i) {
      const double *restrict above = K + i * n, share = U[i * n + k];
      for (int j = 0; j <= i; ++j) row[j] -= share * above[j];
    }
    for (int j = 0; j <= k; ++j) row[j] *= inverse_size;
  }
  if (V) memset(V, 0, sizeof(double) * n * n);
  for (int k = 0; V && k < n; ++k)
    for (int i = 0; i <= k; ++i) {
      const double *restrict row = K + k * n, share = row[i];
      for (int j = 0; j <= k; ++j) V[i * n + j] += share * row[j];
    }
  return 1;
}

#if CONTACTS > 0
/* P = W^+ `(NQ, ROWS)` by one-sided Jacobi rotations of the rows, and R = 1 - W W^+; small singular values count as
 * zero */
static void pseudo_inverse(double *restrict W, double *restrict P, double (*restrict R)[ROWS]) {
  double V[ROWS * ROWS], square[ROWS], most = 0.0;
  for (int r = 0; r < ROWS * ROWS; ++r) V[r] = r % (ROWS + 1) == 0 ? 1.0 : 0.0;
  for (int sweep = 0; sweep < 30; ++sweep) {
    int turned = 0;
    for (int r = 0; r < ROWS; ++r)
      for (int s = r + 1; s < ROWS; ++s) {
        double *u = W + r * NQ, *v = W + s * NQ;
        const double uu = dot(u, u, NQ), vv = dot(v, v, NQ), uv = dot(u, v, NQ);
        double zeta, t, cosine, sine;
        if (fabs(uv) <= 0.5 * EPSILON * sqrt(uu * vv)) continue;
        turned = 1, zeta = (vv - uu) / (2.0 * uv);
        t = (zeta < 0.0 ? -1.0 : 1.0) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
        cosine = 1.0 / sqrt(1.0 + t * t), sine = cosine * t;
        for (int j = 0; j < NQ; ++j) {
          const double x = u[j], y = v[j];
          u[j] = cosine * x - sine * y, v[j] = sine * x + cosine * y;
        }
        for (int j = 0; j < ROWS; ++j) {
          const double x = V[j * ROWS + r], y = V[j * ROWS + s];
          V[j * ROWS + r] = cosine * x - sine * y, V[j * ROWS + s] = sine * x + cosine * y;
        }
      }
    if (!turned) break;
  }
  for (int r = 0; r < ROWS; ++r) square[r] = dot(W + r * NQ, W + r * NQ, NQ), most = fmax(most, square[r]);
  for (int j = 0; j < NQ; ++j)
    for (int s = 0; s < ROWS; ++s) {
      double sum = 0.0;
      for (int r = 0; r < ROWS; ++r)
        if (square[r] > RANK_TOLERANCE * RANK_TOLERANCE * most) sum += W[r * NQ + j] / square[r] * V[s * ROWS + r];
      P[j * ROWS + s] = sum;
    }
  for (int r = 0; r < ROWS; ++r)
    for (int s = 0; s < ROWS; ++s) {
      R[r][s] = 0.0;
      for (int i = 0; i < ROWS; ++i)
        if (!(square[i] > RANK_TOLERANCE * RANK_TOLERANCE * most)) R[r][s] += V[r * ROWS + i] * V[s * ROWS + i];
    }
}
#endif

/* qdd and lambda under impressed forces Q: qdd = M^-1 Q + L (b - A M^-1 Q), lambda = S (b - A M^-1 Q) */
static void motion_under(const equations *restrict e, const double *restrict Q, double *restrict qdd,
                         double *restrict multiplier) {
  double free[NQ], gap[SOME(ROWS)] = {0.0};
  for (int i = 0; i < NQ; ++i) qdd[i] = free[i] = dot(e->M_inv[i], Q, NQ);
  for (int r = 0; r < ROWS; ++r) gap[r] = e->b[r] - dot(e->A[r], free, NQ);
  for (int r = 0; r < ROWS; ++r) multiplier[r] = dot(e->S[r], gap, ROWS);
  for (int i = 0; i < NQ; ++i) qdd[i] += dot(e->L[i], gap, ROWS);
}

static int assemble(const double *restrict q, const double *restrict qd, const double *restrict tau,
                    const unsigned char *restrict closed, equations *restrict e) {
  double sine[NQ], cosine[NQ], out[MECHANICS], K[NQ * NQ], Q[NQ];
  const double *next = out + NQ * NQ + 3 * NQ;
  (void)closed;
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  mechanics(q, qd, tau, sine, cosine, out);
  memcpy(e->M, out, sizeof e->M);
  memcpy(e->Q_C, out + NQ * NQ, sizeof e->Q_C);
  memcpy(e->Q_G, out + NQ * NQ + NQ, sizeof e->Q_G);
  memcpy(e->Q_D, out + NQ * NQ + 2 * NQ, sizeof e->Q_D);
  memcpy(e->contact, next, sizeof(touching) * CONTACTS), next += sizeof(touching) / sizeof(double) * CONTACTS;
  memcpy(e->x, next, sizeof(double) * INPUTS), next += INPUTS;
  memcpy(e->phi, next, sizeof(double) * FEATURES), next += FEATURES;
  memcpy(e->expected, next, sizeof e->expected);
  for (int i = 0; i < NQ; ++i) Q[i] = e->Q_C[i] + e->Q_G[i] + e->Q_D[i] + TORQUE_SCALE[i] * tau[i];
  if (!inverse(&e->M[0][0], NQ, K, &e->M_inv[0][0])) return 0;
  memcpy(e->H, e->M_inv, sizeof e->H);
#if CONTACTS > 0
  {
    double W[ROWS * NQ], P[NQ * ROWS], along[ROWS][NQ];
    for (int i = 0; i < CONTACTS; ++i) {
      e->closed[i] = closed == NULL || closed[i] != 0;
      for (int j = 0; j < NQ; ++j) e->A[i][j] = e->closed[i] ? e->contact[i].A[j] : 0.0;
      e->b[i] = e->closed[i] ? e->contact[i].b : 0.0;
    }
    for (int r = 0; r < ROWS; ++r) combine(&e->M_inv[0][0], e->A[r], NQ, NQ, along[r]);
    for (int r = 0; r < ROWS; ++r)
      for (int i = 0; i < NQ; ++i) W[r * NQ + i] = dot(K + i * NQ, e->A[r], i + 1);
    pseudo_inverse(W, P, e->hidden);
    for (int r = 0; r < ROWS; ++r)
      if (!e->closed[r]) e->hidden[r][r] = 0.0;
    for (int r = 0; r < ROWS; ++r)
      for (int s = 0; s < ROWS; ++s) {
        double sum = 0.0;
        for (int i = 0; i < NQ; ++i) sum += P[i * ROWS + r] * P[i * ROWS + s];
        e->S[r][s] = sum;
      }
    for (int i = 0; i < NQ; ++i)
      for (int r = 0; r < ROWS; ++r) {
        double sum = 0.0;
        for (int k = i; k < NQ; ++k) sum += K[k * NQ + i] * P[k * ROWS + r];
        e->L[i][r] = sum;
      }
    for (int i = 0; i < NQ; ++i)
      for (int j = 0; j < NQ; ++j)
        for (int r = 0; r < ROWS; ++r) e->H[i][j] -= e->L[i][r] * along[r][j];
  }
#endif
  motion_under(e, Q, e->qdd, e->load);
  return 1;
}

/* ---- contact friction -mu lambda s(v) with s(v) = v / sqrt(|v|^2 + eps^2), proportional to lambda ---- */

#if COULOMB > 0
/* u = -J_E^T s(v), the generalized force of a unit friction force */
static void against_sliding(const touching *at, double smoothing, double *u) {
  const double size = sqrt(dot(at->sliding, at->sliding, 3) + smoothing * smoothing);
  for (int j = 0; j < NQ; ++j) {
    u[j] = 0.0;
    for (int x = 0; x < 3; ++x) u[j] -= at->sliding_jacobian[x][j] * at->sliding[x] / size;
  }
}

/* gain = U (I + L^T U)^-1 `(NQ, ROWS)`, which maps the multiplier without friction to the friction */
static int friction_gain(const equations *e, double *restrict gain) {
  double U[ROWS][NQ], X[ROWS][ROWS + NQ];
  memset(U, 0, sizeof U);
  for (int f = 0; f < COULOMB; ++f) {
    against_sliding(&e->contact[COULOMB_CONTACT[f]], COULOMB_SMOOTHING[f], U[COULOMB_CONTACT[f]]);
    for (int j = 0; j < NQ; ++j) U[COULOMB_CONTACT[f]][j] *= COULOMB_COEFFICIENT[f];
  }
  /* gain (I + L^T U) = U, so (I + L^T U)^T gain^T = U^T */
  for (int r = 0; r < ROWS; ++r) {
    for (int s = 0; s < ROWS; ++s) {
      X[r][s] = r == s ? 1.0 : 0.0;
      for (int j = 0; j < NQ; ++j) X[r][s] += e->L[j][s] * U[r][j];
    }
    memcpy(X[r] + ROWS, U[r], sizeof U[r]);
  }
  for (int r = 0; r < ROWS; ++r) {
    int pivot = r;
    for (int s = r + 1; s < ROWS; ++s) pivot = fabs(X[s][r]) > fabs(X[pivot][r]) ? s : pivot;
    if (X[pivot][r] == 0.0) return 0;
    for (int c = 0; c < ROWS + NQ; ++c) {
      const double kept = X[r][c];
      X[r][c] = X[pivot][c], X[pivot][c] = kept;
    }
    for (int s = 0; s < ROWS; ++s) {
      const double factor = X[s][r] / X[r][r];
      for (int c = r; s != r && c < ROWS + NQ; ++c) X[s][c] -= factor * X[r][c];
    }
  }
  for (int j = 0; j < NQ; ++j)
    for (int r = 0; r < ROWS; ++r) gain[j * ROWS + r] = X[r][ROWS + j] / X[r][r];
  return 1;
}

/* the multiplier under known and expected forces with friction of contacts */
static void pressing_forces(const double *restrict tau, const double *restrict gain, equations *restrict e) {
  double Q[NQ], qdd[NQ], load[ROWS];
  for (int j = 0; j < NQ; ++j)
    Q[j] = e->Q_C[j] + e->Q_G[j] + e->Q_D[j] + TORQUE_SCALE[j] * tau[j] + e->expected[j];
  motion_under(e, Q, qdd, load);
  for (int j = 0; j < NQ; ++j) Q[j] += dot(gain + j * ROWS, load, ROWS);
  motion_under(e, Q, qdd, e->pressing);
}
#endif

/* ---- every quantity as an affine map of the forces: z = B_Q Q + B_z Q_z + B_N Q_N + B_F Q_F + o ---- */

typedef struct {
  double B_Q[SIZE_OF_ALL][NQ]; /* on the joint force Q */
  double B_z[SIZE_OF_ALL][NQ]; /* on the friction Q_z of contacts */
  double B_N[SIZE_OF_ALL][NQ]; /* on the part of Q along the constraint, which does not affect the motion */
  double B_F[SIZE_OF_ALL][NQ]; /* on the joint friction alone */
  double o[SIZE_OF_ALL];
} affine;

int forcegp_size(unsigned quantities) {
  int size = 0;
  for (int bit = 0; bit < QUANTITIES; ++bit) size += quantities >> bit & 1u ? SIZES[bit] : 0;
  return size;
}

/* the rows of the requested quantities, in the order of their bits in the header */
static int maps(const equations *restrict e, const double *restrict gain, unsigned wanted, affine *restrict z) {
  const int size = forcegp_size(wanted);
  double lambda_0[SOME(ROWS)]; /* (A M^-1 A^T)^+ b */
  int row = 0;
  memset(z->B_Q, 0, sizeof(double[NQ]) * size), memset(z->B_z, 0, sizeof(double[NQ]) * size);
  memset(z->B_N, 0, sizeof(double[NQ]) * size), memset(z->B_F, 0, sizeof(double[NQ]) * size);
  memset(z->o, 0, sizeof(double) * size);
  for (int r = 0; r < ROWS; ++r) lambda_0[r] = dot(e->S[r], e->b, ROWS);
  if (wanted & FORCEGP_QDD) /* qdd = L b + H (Q + Q_z) */
    for (int i = 0; i < NQ; ++i, ++row) {
      memcpy(z->B_Q[row], e->H[i], sizeof e->H[i]), memcpy(z->B_z[row], e->H[i], sizeof e->H[i]);
      z->o[row] = dot(e->L[i], e->b, ROWS);
    }
  if (wanted & FORCEGP_QDD_FREE) /* M^-1 Q */
    for (int i = 0; i < NQ; ++i, ++row)
      memcpy(z->B_Q[row], e->M_inv[i], sizeof e->H[i]), memcpy(z->B_N[row], e->M_inv[i], sizeof e->H[i]);
  for (int kind = 0; kind < 3; ++kind) {
    /* lambda = (A M^-1 A^T)^+ b - L^T (Q + Q_z), A^T lambda, and n lambda of each contact */
    static const unsigned of_multiplier[3] = {FORCEGP_MULTIPLIER, FORCEGP_CONSTRAINT_FORCE, FORCEGP_CONTACT_FORCE};
    static const int rows[3] = {ROWS, NQ, 3 * CONTACTS};
    if (!(wanted & of_multiplier[kind])) continue;
    for (int i = 0; i < rows[kind]; ++i, ++row)
      for (int r = 0; r < ROWS; ++r) {
        double share = kind == 0 ? (i == r ? 1.0 : 0.0) : e->A[r][i % NQ];
        if (kind == 2) share = i / 3 == r ? e->contact[r].normal[i % 3] : 0.0;
        for (int j = 0; j < NQ; ++j) z->B_Q[row][j] -= share * e->L[j][r];
        z->o[row] += share * lambda_0[r];
        memcpy(z->B_z[row], z->B_Q[row], sizeof z->B_Q[row]), memcpy(z->B_N[row], z->B_Q[row], sizeof z->B_Q[row]);
      }
  }
  for (int i = 0; wanted & FORCEGP_TOTAL_FORCE && i < NQ; ++i, ++row) z->B_Q[row][i] = z->B_z[row][i] = z->B_N[row][i] = 1.0;
  for (int i = 0; wanted & FORCEGP_JOINT_FORCE && i < NQ; ++i, ++row) z->B_Q[row][i] = z->B_N[row][i] = 1.0;
  for (int i = 0; wanted & FORCEGP_CONTACT_FRICTION && i < NQ; ++i, ++row) z->B_z[row][i] = 1.0;
  for (int i = 0; wanted & FORCEGP_JOINT_FRICTION && i < NQ; ++i, ++row) z->B_F[row][i] = 1.0, z->o[row] = e->Q_D[i];
#if COULOMB > 0
  for (row = 0; row < size; ++row) { /* B_Q - G L^T, B_z - G L^T, o + G lambda_0 with G = B_z gain */
    double G[ROWS];
    combine(gain, z->B_z[row], NQ, ROWS, G);
    for (int r = 0; r < ROWS; ++r) {
      z->o[row] += G[r] * lambda_0[r];
      for (int j = 0; j < NQ; ++j) {
        const double back = G[r] * e->L[j][r];
        z->B_Q[row][j] -= back, z->B_z[row][j] -= back, z->B_N[row][j] -= back;
      }
    }
  }
#else
  (void)gain;
#endif
  return size;
}

/* ---- the latent forces f of the priors, Q = m + sum of E f ---- */

typedef struct {
  double mean[COMPONENTS], prior[COMPONENTS]; /* posterior mean of f, and its prior variance */
  double rest[COMPONENTS];                    /* diagonal part D of the posterior covariance */
  double E[COMPONENTS][NQ];                   /* generalized force of each f */
  double V[FUNCTIONS];                        /* whitened functions of all components */
  const forcegp_learned *learned;             /* the online state, or NULL */
  const double *folded;                       /* weights of kernels and features; NULL means those of the mean */
} latent;

/* posterior of component k from its functions V: m covariances k(x, Z), with prior variance `variance`, and
 * features phi(x) */
static void component(const double *restrict V, int m, int features, double variance, const double *restrict weights,
                      const double *restrict whitening, int kept, int spread, int k, latent *restrict f) {
  const double more = SIGN > 0.0 ? 0.0 : dot(V + m, V + m, features);
  double *restrict white = f->V + FUNCTION[k];
  if (f->folded) weights = f->folded + FOLDED[k];
  f->mean[k] = dot(V, weights, m + features);
  f->prior[k] = f->rest[k] = variance + more; /* squares of features do not cancel */
  if (!spread) return;
  if (whitening) { /* D = k - |R^T k(Z, x)|^2, the residual variance given the support points */
    combine(whitening, V, m, kept, white);
    f->rest[k] = fmax(variance - dot(white, white, kept), 0.0);
  } else
    memcpy(white, V, sizeof(double) * (kept = m));
  memcpy(white + kept, V + m, sizeof(double) * features);
  if (INDEPENDENT[k] && !f->learned) f->rest[k] += dot(white, white, kept + features);
}

/* HELPERS: each is included only if a prior uses it */

/* E = 1 for a force on each joint */
static void identity(int count, double (*restrict E)[NQ]) {
  for (int k = 0; k < count; ++k)
    for (int j = 0; j < NQ; ++j) E[k][j] = j == k ? 1.0 : 0.0;
}

/* E = A^T L^T for a joint force along the constraint */
static void along_constraint(const equations *restrict e, double (*restrict E)[NQ]) {
  for (int k = 0; k < NQ; ++k)
    for (int j = 0; j < NQ; ++j) {
      E[k][j] = 0.0;
      for (int r = 0; r < ROWS; ++r) E[k][j] += e->A[r][j] * e->L[k][r];
    }
}

/* E = J_E^T (t_1, t_2) for any force along the surface */
static void tangential(const equations *restrict e, int c, double (*restrict E)[NQ]) {
  const touching *at = &e->contact[c];
  memset(E, 0, sizeof(double[2][NQ]));
  for (int t = 0; e->closed[c] && t < 2; ++t)
    for (int x = 0; x < 3; ++x)
      for (int j = 0; j < NQ; ++j) E[t][j] += at->tangent[t][x] * at->jacobian[x][j];
}

/* E for friction that opposes sliding: viscous and dry friction, and, in proportion to the multiplier, Coulomb,
 * Stribeck and torsional friction; returns 0 if the contact jams with the friction coefficient mu */
static int against(const equations *restrict e, const double *restrict qd, int c, const int *restrict terms, int count,
                   double smoothing, double mu, double stribeck_speed, double torsion_smoothing, double (*restrict E)[NQ]) {
  enum { VISCOUS, DRY, COULOMBS, STRIBECKS, TORSION };
  const touching *at = &e->contact[c];
  const double square = dot(at->sliding, at->sliding, 3), size = sqrt(square + smoothing * smoothing);
  const double rate = dot(at->turning, qd, NQ), spin = sqrt(rate * rate + torsion_smoothing * torsion_smoothing);
  const double fading = exp(-square / (stribeck_speed * stribeck_speed));
  double push[NQ], relief = 1.0, load;
  int loaded = 0;
  memset(E, 0, sizeof(double[NQ]) * count);
  if (!e->closed[c]) return 1;
  for (int j = 0; j < NQ; ++j) {
    push[j] = 0.0;
    for (int x = 0; x < 3; ++x) push[j] -= at->sliding_jacobian[x][j] * at->sliding[x];
    relief += mu * e->L[j][c] * push[j] / size;
  }
  load = fmax(e->load[c], 0.0) / relief; /* lambda under the analytical forces with friction mu lambda s */
  for (int k = 0; k < count; ++k) {
    loaded |= terms[k] >= COULOMBS;
    for (int j = 0; j < NQ; ++j) {
      const double dry = push[j] / size;
      E[k][j] = terms[k] == VISCOUS    ? push[j]
                : terms[k] == DRY      ? dry
                : terms[k] == COULOMBS ? load * dry
                : terms[k] == STRIBECKS ? load * dry * fading
                                        : -load * at->turning[j] * rate / spin;
    }
  }
  return !loaded || relief > 0.0;
}

/* E = d(mu u)/d(log mu, log eps) lambda, with lambda under known and expected forces and friction of contacts */
static void friction_error(const equations *restrict e, int c, double mu, double smoothing, double (*restrict E)[NQ]) {
  const touching *at = &e->contact[c];
  const double square = dot(at->sliding, at->sliding, 3), fading = smoothing * smoothing / (square + smoothing * smoothing);
  double u[NQ];
  against_sliding(at, smoothing, u);
  for (int j = 0; j < NQ; ++j) {
    E[0][j] = e->closed[c] ? mu * e->pressing[c] * u[j] : 0.0;
    E[1][j] = -fading * E[0][j];
  }
}

/* u_j = |x - z_j|^2 for scaled inputs x and m support points, computed input by input */
static void squares(const double *restrict x, const double *restrict Z, int width, int m, double *restrict u) {
  for (int j = 0; j < m; ++j) u[j] = 0.0;
  for (int d = 0; d < width; ++d)
    for (int j = 0; j < m; ++j) {
      const double apart = x[d] - Z[(long)d * m + j];
      u[j] += apart * apart;
    }
}

/* exp(-r^2/2) */
static void squaredexponential(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = exp(-0.5 * fmin(u[j], 600.0));
}

/* the derivative of a profile with respect to r^2 */
static void squaredexponential_slope(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = -0.5 * exp(-0.5 * fmin(u[j], 600.0));
}

static void matern32_slope(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = -1.5 * exp(-fmin(sqrt(3.0 * u[j]), 300.0));
}

static void matern52_slope(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = sqrt(5.0 * u[j]), u[j] = -5.0 / 6.0 * (1.0 + u[j]) * exp(-fmin(u[j], 300.0));
}

/* df/dx for f = sum of h_j |x - z_j|^2 or, for a linear kernel, f = sum of h_j x^T z_j */
static void pull(const double *restrict Z, const double *restrict x, const double *restrict scale,
                 const int *restrict column, int width, int m, const double *restrict h, int stationary,
                 double *restrict slope) {
  double sum = 0.0;
  for (int j = 0; j < m; ++j) sum += h[j];
  for (int d = 0; d < width; ++d) {
    const double along = dot(Z + (long)d * m, h, m);
    slope[column[d]] += scale[d] * (stationary ? 2.0 * (x[d] * sum - along) : along);
  }
}

/* (1 + r) exp(-r) at sqrt(3) r */
static void matern32(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = sqrt(3.0 * u[j]), u[j] = (1.0 + u[j]) * exp(-fmin(u[j], 300.0));
}

/* (1 + r + r^2/3) exp(-r) at sqrt(5) r */
static void matern52(double *restrict u, int m) {
  for (int j = 0; j < m; ++j) u[j] = sqrt(5.0 * u[j]), u[j] = (1.0 + u[j] + u[j] * u[j] / 3.0) * exp(-fmin(u[j], 300.0));
}

/* PRIORS */

#if defined INERTIAL || defined PAYLOAD
/* E = -[Y(q, qdd, qd), diag qdd] S in the given columns, for errors of inertial parameters of links and of drives */
static void inertial(const double *restrict q, const double *restrict qd, const double *restrict qdd, int start, int count,
                     const int *restrict column, const double *restrict units, latent *restrict f) {
  double sine[NQ], cosine[NQ], Y[10 * NQ + NQ][NQ] = {{0.0}};
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]), Y[10 * NQ + i][i] = qdd[i];
  regressor(q, qd, qdd, sine, cosine, Y[0]);
  for (int k = 0; k < count; ++k)
    for (int j = 0; j < NQ; ++j) f->E[start + k][j] = -units[k] * Y[column[k]][j];
}
#endif

/* E for errors of inertia and of the scales of torques at the acceleration qdd or, with NULL, at the acceleration under
 * the analytical forces and at the torques tau */
static void inertial_errors(const double *q, const double *qd, const double *tau, const equations *e, const double *qdd,
                            latent *f) {
  (void)q, (void)qd, (void)tau, (void)e, (void)qdd, (void)f;
#ifdef DRIVES
  int touches = 0;
#if CONTACTS > 0
  for (int c = 0; c < CONTACTS; ++c) touches |= e->closed[c];
#endif
  memset(f->E[DRIVES], 0, sizeof(double) * NQ * NQ);
  for (int i = 0; i < NQ; ++i) {
    const double known = e->Q_C[i] + e->Q_G[i] + e->Q_D[i];
    const double torque = DRIVES_MEASURED && qdd && !touches ? dot(e->M[i], qdd, NQ) - known : TORQUE_SCALE[i] * tau[i];
    f->E[DRIVES + i][i] = DRIVES_STD * torque;
  }
#endif
#ifdef PAYLOAD
  inertial(q, qd, PAYLOAD_MEASURED && qdd ? qdd : e->qdd, PAYLOAD, PAYLOAD_COUNT, PAYLOAD_COLUMN, PAYLOAD_UNITS, f);
#endif
#ifdef INERTIAL
  inertial(q, qd, qdd ? qdd : e->qdd, INERTIAL, INERTIAL_COUNT, INERTIAL_COLUMN, INERTIAL_UNITS, f);
#endif
}

/* ---- computing quantities from the posterior of the forces ---- */

/* z = o + B_Q (m + sum of E f) + B_z ... */
static void read_mean(const affine *restrict z, const latent *restrict f, const double *restrict prior_mean, int size,
                      double *restrict mean) {
  double force[4][NQ];
  memset(force, 0, sizeof force);
  memcpy(force[JOINT], prior_mean, sizeof force[JOINT]);
  for (int k = 0; k < COMPONENTS; ++k)
    for (int j = 0; j < NQ; ++j) {
      force[TARGET[k]][j] += f->E[k][j] * f->mean[k];
      if (IS_FRICTION[k]) force[JOINT_FRICTION][j] += f->E[k][j] * f->mean[k];
    }
  for (int a = 0; a < size; ++a)
    mean[a] = z->o[a] + dot(z->B_Q[a], force[JOINT], NQ) + dot(z->B_z[a], force[CONTACT], NQ) +
              dot(z->B_N[a], force[CONSTRAINT], NQ) + dot(z->B_F[a], force[JOINT_FRICTION], NQ);
}

/* copy the lower triangle to the upper one */
static void mirror(double *restrict C, int n) {
  for (int a = 0; a < n; ++a)
    for (int b = a + 1; b < n; ++b) C[a * n + b] = C[b * n + a];
}

/* W^T for W = B E, which maps the latent forces to quantities, `(COMPONENTS, size)` */
static void operators(const affine *restrict z, const latent *restrict f, int size, double *restrict W) {
  for (int k = 0; k < COMPONENTS; ++k)
    for (int a = 0; a < size; ++a) {
      const double *B = TARGET[k] == CONTACT ? z->B_z[a] : TARGET[k] == CONSTRAINT ? z->B_N[a] : z->B_Q[a];
      W[k * size + a] = dot(B, f->E[k], NQ) + (IS_FRICTION[k] ? dot(z->B_F[a], f->E[k], NQ) : 0.0);
    }
}

/* sigma^2 + s^2 exp(-(v/v_s)^2), the variance of the tangential force of a contact that is no function of the state */
static double tip_variance(const equations *restrict e, int contact) {
  const touching *at = &e->contact[contact];
  const double *tip = TIP[contact];
  return tip[0] + tip[1] * exp(-dot(at->sliding, at->sliding, 3) / (tip[2] * tip[2]));
}

/* a column p = B_z J_E^T (1 - n n^T) std for this force along world axis x; zero while the contact is open or if the size of
 * the force is not learned */
static void contact_unknown(const affine *restrict z, const equations *restrict e, int contact, int x, int size,
                            double *restrict p) {
  const touching *at = &e->contact[contact];
  const double std = TIP_LEARNED[contact] && e->closed[contact] ? sqrt(tip_variance(e, contact)) : 0.0;
  for (int a = 0; a < size; ++a) p[a] = std * dot(z->B_z[a], at->sliding_jacobian[x], NQ);
}

/* up to four rows of C from the column `start` on, each times V and W^T of its component, so that passes over `root` are few */
typedef struct {
  const double *row[4], *W[4];
  double V[4];
  int start, count;
} pending;

/* to += sum of by_t r_t for n numbers, a multiple of LANES */
static void add_four(int n, double by0, double by1, double by2, double by3, const double *restrict r0,
                     const double *restrict r1, const double *restrict r2, const double *restrict r3, double *restrict to) {
  for (int c = 0; c < n; c += LANES)
    for (int lane = c; lane < c + LANES; ++lane) to[lane] += by0 * r0[lane] + by1 * r1[lane] + by2 * r2[lane] + by3 * r3[lane];
}

static void add_rows(pending *restrict p, int size, int width, double (*restrict root)[PADDED]) {
  static const double none[PADDED + SIZE_OF_ALL] = {0.0};
  const int count = p->count, start = p->start;
  if (count == 0) return;
  for (int t = count; t < 4; ++t) p->row[t] = p->W[t] = none, p->V[t] = 0.0;
  for (int a = 0; a < size; ++a) {
    const double w0 = p->W[0][a], w1 = p->W[1][a], w2 = p->W[2][a], w3 = p->W[3][a];
    if (w0 != 0.0 || w1 != 0.0 || w2 != 0.0 || w3 != 0.0)
      add_four(width - start, p->V[0] * w0, p->V[1] * w1, p->V[2] * w2, p->V[3] * w3, p->row[0], p->row[1], p->row[2],
               p->row[3], root[a] + start);
  }
  p->count = 0;
}

/* root = W T `(size, RANK)` for W^T `(COMPONENTS, size)`, with the row T_k = V^T C of each component. Rows of C are used
 * directly for a component with one function, or with one nonzero entry of W. Returns the number of columns, and the
 * number of nonzero entries of W for each component */
static int carry(const latent *restrict f, const double *restrict W, int size, double (*restrict root)[PADDED],
                 int *restrict uses) {
  pending rows;
  const int width = f->learned ? PADDED : WIDTH;
  rows.count = rows.start = 0;
  for (int a = 0; a < size; ++a) memset(root[a], 0, sizeof(double) * width);
  for (int k = 0; k < COMPONENTS; ++k) {
    const double *V = f->V + FUNCTION[k], *w = W + (long)k * size;
    const int n = FUNCTION[k + 1] - FUNCTION[k], start = f->learned ? FUNCTION[k] / LANES * LANES : START(k);
    double T[PADDED];
    int nonzero = 0, whole;
    uses[k] = 0;
    for (int a = 0; a < size; ++a) uses[k] += w[a] != 0.0;
    for (int i = 0; uses[k] && i < n; ++i) nonzero |= V[i] != 0.0;
    if (!nonzero || (INDEPENDENT[k] && !f->learned)) continue;
    whole = f->learned || (n > 1 && uses[k] > 1);
    if (whole || n > 1 || start != rows.start) add_rows(&rows, size, width, root);
    if (whole && !f->learned) combine(ROOTS[k], V, n, width - start, T);
#if ONLINE
    if (f->learned) memset(T, 0, sizeof T);
    for (int j = FUNCTION[k], own = 1; f->learned && j < RANK; ++j, own += own < n) /* C = K^T */
      T[j - start] = dot(f->learned->root + (long)j * (j + 1) / 2 + FUNCTION[k], V, own);
#endif
    for (int i = 0; i < (whole ? 1 : n); ++i) {
      rows.row[rows.count] = whole ? T : ROOTS[k] + (long)i * (width - start);
      rows.W[rows.count] = w, rows.V[rows.count] = whole ? 1.0 : V[i], rows.start = start;
      if (++rows.count == 4 || whole) add_rows(&rows, size, width, root);
    }
    if (n > 1) add_rows(&rows, size, width, root);
  }
  add_rows(&rows, size, width, root);
  return width;
}

/* dots = a^T b for four rows b of n numbers, a multiple of LANES */
static void four_dots(const double *restrict a, double (*restrict b)[PADDED], int n, double *restrict dots) {
  double lanes[4][LANES] = {{0.0}};
  for (int c = 0; c < n; c += LANES)
    for (int row = 0; row < 4; ++row)
      for (int lane = 0; lane < LANES; ++lane) lanes[row][lane] += a[c + lane] * b[row][c + lane];
  for (int row = 0; row < 4; ++row) {
    for (int half = LANES / 2; half > 0; half /= 2)
      for (int lane = 0; lane < half; ++lane) lanes[row][lane] += lanes[row][lane + half];
    dots[row] = lanes[row][0];
  }
}

/* the lower triangle of W D W^T + W T T^T W^T for W^T `(COMPONENTS, size)`; 0 if a variance is below rounding error */
static int learned_covariance(const latent *restrict f, const double *restrict W, int size, double *restrict covariance) {
  double root[SIZE_OF_ALL + 3][PADDED], before[SIZE_OF_ALL] = {0.0};
  int uses[COMPONENTS], resolved = 1;
  const int width = carry(f, W, size, root, uses);
  for (int a = 0; a < 3; ++a) memset(root[size + a], 0, sizeof(double) * width);
  for (int a = 0; a < size; ++a)
    for (int b = 0; b <= a; b += 4) {
      double dots[4];
      four_dots(root[a], root + b, width, dots);
      for (int i = 0; i < 4 && b + i <= a; ++i) covariance[a * size + b + i] = SIGN * dots[i];
    }
  for (int k = 0; k < COMPONENTS; ++k) {
    const double *w = W + (long)k * size;
    if (!uses[k] || (f->prior[k] == 0.0 && f->rest[k] == 0.0)) continue;
    for (int a = 0; a < size; ++a) {
      before[a] += w[a] * w[a] * f->prior[k];
      for (int b = 0; w[a] != 0.0 && b <= a; ++b) covariance[a * size + b] += w[a] * f->rest[k] * w[b];
    }
  }
  for (int a = 0; a < size; ++a) resolved &= !(covariance[a * size + a] < SMALLEST_FRACTION * before[a]);
  return resolved;
}

/* that of W = B E, plus the variance of unknown forces */
static int read_covariance(const affine *restrict z, const equations *restrict e, const latent *restrict f,
                           const double *restrict unknown, int size, double *restrict covariance) {
  double W[COMPONENTS * SIZE_OF_ALL], p[SIZE_OF_ALL];
  int resolved;
  operators(z, f, size, W);
  resolved = learned_covariance(f, W, size, covariance);
  for (int a = 0; a < size; ++a) {
    double carried[NQ];
    for (int j = 0; j < NQ; ++j) carried[j] = (z->B_Q[a][j] + z->B_F[a][j]) * unknown[j];
    for (int b = 0; b <= a; ++b)
      covariance[a * size + b] += dot(carried, z->B_Q[b], NQ) + dot(carried, z->B_F[b], NQ);
  }
  for (int k = 0; k < 3 * CONTACTS; ++k) {
    contact_unknown(z, e, k / 3, k % 3, size, p);
    for (int a = 0; a < size; ++a)
      for (int b = 0; b <= a; ++b) covariance[a * size + b] += p[a] * p[b];
  }
  mirror(covariance, size);
  return resolved;
}

/* m, the prior mean of Q */
static void expected_force(const equations *restrict e, const double *restrict tau, double *restrict m) {
  for (int i = 0; i < NQ; ++i)
    m[i] = MEAN_TERMS[0] * e->Q_C[i] + MEAN_TERMS[1] * e->Q_G[i] + MEAN_TERMS[2] * e->Q_D[i] +
           MEAN_TERMS[3] * TORQUE_SCALE[i] * tau[i];
}

/* distance by which speed and torque exceed the training data, in standard deviations of these data */
static void distance(const double *restrict qd, const double *restrict tau, double *restrict beyond) {
  for (int i = 0; i < NQ; ++i) {
    const double v = fmax(fmax(LOW[0][i] - qd[i], qd[i] - HIGH[0][i]), 0.0) / SPREAD[0][i];
    const double torque = TORQUE_SCALE[i] * tau[i];
    const double t = fmax(fmax(LOW[1][i] - torque, torque - HIGH[1][i]), 0.0) / SPREAD[1][i];
    beyond[i] = sqrt(v * v + t * t);
  }
}

/* the equations of motion and the gain of friction at a state */
static int prepare(const double *q, const double *qd, const double *tau, const unsigned char *closed, equations *e,
                   double *gain) {
  (void)gain;
  for (int i = 0; i < NQ; ++i)
    if (!isfinite(q[i]) || !isfinite(qd[i]) || !isfinite(tau[i])) return FORCEGP_NOT_FINITE;
  if (!assemble(q, qd, tau, closed, e)) return FORCEGP_NO_INERTIA;
#if COULOMB > 0
  if (!friction_gain(e, gain)) return FORCEGP_JAMMED;
  pressing_forces(tau, gain, e);
#endif
  return 0;
}

/* equations of motion and posterior of the forces at a state */
typedef struct {
  equations e;
  latent f;
  double gain[NQ * SOME(ROWS)], prior_mean[NQ], far[NQ];
} situation;

/* inertia errors are multiplied by the acceleration qdd; see `inertial_errors` */
static int evaluate(const forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                    const unsigned char *closed, const double *qdd, int spread, situation *s) {
  int status = prepare(q, qd, tau, closed, &s->e, s->gain);
  if (status) return status;
  distance(qd, tau, s->far);
  expected_force(&s->e, tau, s->prior_mean);
  s->f.learned = learned, s->f.folded = NULL;
#if ONLINE
  if (learned) s->f.folded = learned->folded;
#endif
  if ((status = latent_forces(q, qd, tau, &s->e, s->gain, spread, &s->f)) != 0) return status;
  inertial_errors(q, qd, tau, &s->e, qdd, &s->f);
  return 0;
}

/* variance of forces other than the learned ones: of sticking joints, beyond the trained region, and torque noise */
static void unknown_forces(const double *qd, const double *far, int noise, double *unknown) {
  for (int i = 0; i < NQ; ++i) {
    const double slow = qd[i] / STICK_SPEED[i], grown = GROWTH[i] * far[i];
    unknown[i] = STICK_VARIANCE[i] * exp(-slow * slow) + EXTERNAL_VARIANCE[i] + grown * grown;
    if (noise) unknown[i] += TORQUE_VARIANCE[i];
  }
}

/* whether no eigenvalue is clearly negative when variables are scaled by their standard deviations */
static int semidefinite(const double *restrict covariance, int n) {
  double G[SIZE_OF_ALL * SIZE_OF_ALL], scale[SIZE_OF_ALL], most = 0.0;
  for (int i = 0; i < n; ++i) most = fmax(most, covariance[i * n + i]);
  for (int i = 0; i < n; ++i) {
    const double variance = fmax(covariance[i * n + i], ROUNDING * most);
    scale[i] = variance > 0.0 ? 1.0 / sqrt(variance) : 1.0;
  }
  for (int i = 0; i < n; ++i)
    for (int j = 0; j <= i; ++j) {
      double sum = covariance[i * n + j] * scale[i] * scale[j] - dot(G + i * n, G + j * n, j);
      if (i == j && !((sum += NEGATIVE) > 0.0)) return 0;
      G[i * n + j] = i == j ? sqrt(sum) : sum / G[j * n + j];
    }
  return 1;
}

static int all_finite(const double *x, int n) {
  double sum = 0.0; /* 0 x is NaN unless x is finite */
  for (int i = 0; i < n; ++i) sum += 0.0 * x[i];
  return sum == 0.0;
}

/* Forces of contacts that are never closed in the data, or that cannot move, become NaN; loads that contacts share get
 * the mean square of those that motion determines as variance. As in `hidden_forces` of forcegp */
static int undetermined(const situation *restrict s, unsigned wanted, int size, double *restrict mean,
                        double *restrict covariance) {
#if CONTACTS > 0
  double share[SIZE_OF_ALL], square = 0.0, seen = 0.0;
  int owner[SIZE_OF_ALL], lost[SIZE_OF_ALL], whole[ROWS], shared[ROWS], never = 0, found = 0, row = 0;
  for (int r = 0; r < ROWS; ++r) {
    const double part = s->e.hidden[r][r];
    int unseen = NEVER_CLOSED[r];
#if ONLINE
    unseen &= !(s->f.learned && s->f.learned->touched[r] > 0.0);
#endif
    whole[r] = unseen || part > 1.0 - HIDDEN, shared[r] = !(part > 1.0 - HIDDEN) && part > HIDDEN;
    never |= unseen, found |= whole[r] | shared[r];
    if (shared[r]) seen += (1.0 - part) * (!!(wanted & FORCEGP_MULTIPLIER) + !!(wanted & FORCEGP_CONTACT_FORCE));
  }
  if (!found) return 0;
  found = 0;
  for (int bit = 0; bit < QUANTITIES; ++bit)
    for (int i = 0; wanted >> bit & 1u && i < SIZES[bit]; ++i, ++row) {
      const unsigned what = 1u << bit;
      const int r = what == FORCEGP_MULTIPLIER ? i : what == FORCEGP_CONTACT_FORCE ? i / 3 : -1;
      owner[row] = r < 0 ? 0 : r, share[row] = 0.0;
      lost[row] = r < 0 ? what == FORCEGP_CONSTRAINT_FORCE && never : whole[r];
      if (r >= 0 && shared[r]) share[row] = what == FORCEGP_MULTIPLIER ? 1.0 : s->e.contact[r].normal[i % 3];
      found |= lost[row] || share[row] != 0.0;
      if (covariance && share[row] != 0.0) square += mean[row] * mean[row] + covariance[row * size + row];
    }
  for (int a = 0; a < size; ++a) {
    for (int b = 0; covariance && b < size; ++b) {
      covariance[a * size + b] += square / fmax(seen, HIDDEN) * share[a] * share[b] * s->e.hidden[owner[a]][owner[b]];
      if (lost[a] || lost[b]) covariance[a * size + b] = NAN;
    }
    if (lost[a]) mean[a] = NAN;
  }
  return found ? FORCEGP_UNDETERMINED : 0;
#else
  (void)s, (void)wanted, (void)size, (void)mean, (void)covariance;
  return 0;
#endif
}

/* mean and covariance, of undetermined forces too */
static int posterior(const forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                     const unsigned char *closed, unsigned quantities, int noise, double *mean, double *covariance,
                     double *beyond, situation *s) {
  affine z;
  double unknown[NQ], qdd[NQ];
  int size, resolved, status = evaluate(learned, q, qd, tau, closed, NULL, covariance != NULL, s);
  if (status) return status;
  if (beyond) memcpy(beyond, s->far, sizeof s->far);
  if (INERTIA_LEARNED && covariance) { /* at the predicted acceleration */
    maps(&s->e, s->gain, FORCEGP_QDD, &z);
    read_mean(&z, &s->f, s->prior_mean, NQ, qdd);
    inertial_errors(q, qd, tau, &s->e, qdd, &s->f);
  }
  size = maps(&s->e, s->gain, quantities, &z);
  read_mean(&z, &s->f, s->prior_mean, size, mean);
  if (!all_finite(mean, size)) return FORCEGP_OVERFLOW;
  if (!covariance) return 0;
  unknown_forces(qd, s->far, noise, unknown);
  resolved = read_covariance(&z, &s->e, &s->f, unknown, size, covariance);
  if (noise)
    for (int bit = 0, row = 0; bit < QUANTITIES; ++bit)
      for (int i = 0; quantities >> bit & 1u && i < SIZES[bit]; ++i, ++row)
        covariance[row * size + row] += SENSOR_VARIANCE[bit] ? SENSOR_VARIANCE[bit][i] : 0.0;
  if (!all_finite(covariance, size * size)) return FORCEGP_OVERFLOW;
  return resolved && semidefinite(covariance, size) ? 0 : FORCEGP_UNRESOLVED;
}

static int predict(const forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                   const unsigned char *closed, unsigned quantities, int noise, double *mean, double *covariance,
                   double *beyond) {
  situation s;
  const int status = posterior(learned, q, qd, tau, closed, quantities, noise, mean, covariance, beyond, &s);
  return status ? status : undetermined(&s, quantities, forcegp_size(quantities), mean, covariance);
}

int forcegp_equations(const double *q, const double *qd, double *M, double *A) {
  const double tau[NQ] = {0.0};
  equations e;
  if (!assemble(q, qd, tau, NULL, &e)) return FORCEGP_NO_INERTIA;
  memcpy(M, e.M, sizeof e.M);
  if (CONTACTS > 0) memcpy(A, e.A, sizeof e.A);
  return 0;
}

void forcegp_forward_dynamics(const double *q, const double *qd, const double *force, double *qdd) {
  double sine[NQ], cosine[NQ];
  for (int i = 0; i < NQ; ++i) sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  forward_dynamics(q, qd, force, sine, cosine, qdd);
}

int forcegp_predict_learned(const forcegp_learned *learned, long count, const double *q, const double *qd,
                            const double *tau, const unsigned char *closed, unsigned quantities, int noise, double *mean,
                            double *covariance, double *beyond) {
  const int d = forcegp_size(quantities);
  int worst = 0;
  for (long i = 0; i < count; ++i) {
    const int status = predict(learned, q + i * NQ, qd + i * NQ, tau + i * NQ, closed ? closed + i * CONTACTS : NULL,
                               quantities, noise, mean + i * d, covariance ? covariance + i * d * d : NULL,
                               beyond ? beyond + i * NQ : NULL);
    if (status && (!worst || worst == FORCEGP_UNDETERMINED)) worst = status;
  }
  return worst;
}

int forcegp_predict(const double *q, const double *qd, const double *tau, const unsigned char *closed,
                    unsigned quantities, int noise, double *mean, double *covariance, double *beyond) {
  return predict(NULL, q, qd, tau, closed, quantities, noise, mean, covariance, beyond);
}
