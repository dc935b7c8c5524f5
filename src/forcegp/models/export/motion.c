/* ---- motion of trajectories in which dry friction can hold joints, by the method of `rollout/law.py` ---- */

#define FORCEGP_NO_FRICTION @no_friction@
enum { PRIORS = @priors@, MOST_WAVES = @waves@, MAX_EXCHANGES = @max_exchanges@, BLOCK_TRIALS = @block_trials@ };
static const double REGULARIZATION = @regularization@, CONTRADICTION = @contradiction@, INSTANT = @instant@;
static const double STILL = @still@, NEAR_REST = @near_rest@, NUDGE = @nudge@;
static const int STICKS[] = {@sticks@}, FIRST[] = {@first@};
static const int X[PRIORS][3] = {@inputs@}; /* position, rows and width of the inputs of each prior */

/* random features of one prior, and their weights in one sample: waves with frequencies turn `(rows, width, n)` */
typedef struct {
  const double *turn, *phase, *weights;
  long rows, n;
} waves;

/* B = A^-1 B by elimination with pivoting; A is overwritten */
static void solve(double (*restrict A)[NQ], double (*restrict B)[NQ + 1], int columns) {
  for (int i = 0; i < NQ; ++i) {
    int pivot = i;
    for (int j = i + 1; j < NQ; ++j) pivot = fabs(A[j][i]) > fabs(A[pivot][i]) ? j : pivot;
    for (int c = 0; c < NQ; ++c) {
      const double kept = A[i][c];
      A[i][c] = A[pivot][c], A[pivot][c] = kept;
    }
    for (int c = 0; c < columns; ++c) {
      const double kept = B[i][c];
      B[i][c] = B[pivot][c], B[pivot][c] = kept;
    }
    for (int j = i + 1; j < NQ; ++j) {
      const double factor = A[j][i] / A[i][i];
      for (int c = i; c < NQ; ++c) A[j][c] -= factor * A[i][c];
      for (int c = 0; c < columns; ++c) B[j][c] -= factor * B[i][c];
    }
  }
  for (int i = NQ - 1; i >= 0; --i)
    for (int c = 0; c < columns; ++c) {
      for (int j = i + 1; j < NQ; ++j) B[i][c] -= A[i][j] * B[j][c];
      B[i][c] /= A[i][i];
    }
}

/* friction p of joints over a step by block principal pivoting, and the joints that it holds; 0 if there is no solution */
static int dry_friction(const double *restrict qdd, double (*restrict G)[NQ], const double *restrict limit,
                        const double *restrict stopping, double *restrict force, unsigned char *restrict held) {
  double free[NQ], compliance[NQ], most = 0.0, direction[NQ];
  int fewest = NQ + 1, trials = BLOCK_TRIALS;
  for (int i = 0; i < NQ; ++i) most = fmax(most, G[i][i]);
  for (int i = 0; i < NQ; ++i) {
    free[i] = qdd[i] - stopping[i], compliance[i] = fmax(G[i][i], 1e-3 * most);
    direction[i] = limit[i] > 0.0 || free[i] == 0.0 ? 0.0 : copysign(1.0, free[i]);
  }
  for (int trial = 0; trial < MAX_EXCHANGES; ++trial) {
    double A[NQ][NQ], p[NQ][NQ + 1], over[NQ];
    int count = 0, last = 0, wrong[NQ];
    for (int i = 0; i < NQ; ++i) {
      held[i] = direction[i] == 0.0;
      for (int j = 0; j < NQ; ++j)
        A[i][j] = (held[i] ? G[i][j] : 0.0) + (i == j ? (held[i] ? REGULARIZATION * compliance[i] : 1.0) : 0.0);
      p[i][0] = held[i] ? -free[i] : -direction[i] * limit[i];
    }
    solve(A, p, 1);
    for (int i = 0; i < NQ; ++i) {
      double motion = free[i] + REGULARIZATION * compliance[i] * p[i][0];
      force[i] = p[i][0], over[i] = 0.0;
      for (int j = 0; j < NQ; ++j) motion += G[i][j] * p[j][0];
      if (held[i] && fabs(force[i]) > limit[i] + CONTRADICTION * (limit[i] + fabs(free[i] / compliance[i])))
        over[i] = -copysign(1.0, force[i]);
      wrong[i] = over[i] != 0.0 ||
                 (!held[i] && direction[i] * motion < -CONTRADICTION * (fabs(free[i]) + compliance[i] * limit[i]));
      count += wrong[i], last = wrong[i] ? i : last;
    }
    if (!count) return 1;
    trials = count < fewest ? BLOCK_TRIALS : trials - 1;
    fewest = count < fewest ? count : fewest;
    for (int i = 0; i < NQ; ++i)
      if (trials >= 0 ? wrong[i] : i == last) direction[i] = over[i];
  }
  return 0;
}

/* add the residual given the support points, drawn from the prior: f = sum of w cos(omega^T x + phase) */
static void add_waves(const waves *w, const equations *e, long sample, int sticking, latent *f) {
  for (int p = 0; w && p < PRIORS; ++p) {
    const int components = FIRST[p + 1] - FIRST[p];
    double wave[MOST_WAVES];
    if (!w[p].n || (sticking && !STICKS[FIRST[p]])) continue;
    for (int k = 0; k < components; ++k) {
      if (k == 0 || X[p][1] > 1 || w[p].rows > 1) {
        const long row = w[p].rows > 1 ? k : 0, n = w[p].n;
        combine(w[p].turn + row * X[p][2] * n, e->x + X[p][0] + (X[p][1] > 1 ? k * X[p][2] : 0), X[p][2], (int)n, wave);
        for (long i = 0; i < n; ++i) wave[i] = cos(wave[i] + w[p].phase[row * n + i]);
      }
      f->mean[FIRST[p] + k] += dot(wave, w[p].weights + (sample * components + k) * w[p].n, (int)w[p].n);
    }
  }
}

/* friction of joints that slide in given directions, at speeds increased by `more` */
static int slide(const double *q, const double *qd, const double *tau, const waves *w, long sample, const double *way,
                 double more, const double *gain, equations *e, latent *f, double *force) {
  double slip[NQ], speed[NQ], sine[NQ], cosine[NQ], out[@outputs@];
  for (int i = 0; i < NQ; ++i) slip[i] = way[i], speed[i] = qd[i] + more * way[i], sine[i] = sin(q[i]), cosine[i] = cos(q[i]);
  sliding(q, speed, tau, slip, sine, cosine, out);
@copies@  if (sticking_forces(q, speed, tau, e, gain, 0, f) != 0) return FORCEGP_JAMMED;
  add_waves(w, e, sample, 1, f);
  for (int i = 0; i < NQ; ++i) {
    force[i] = MEAN_TERMS[2] * out[i];
    for (int k = 0; k < COMPONENTS; ++k)
      if (STICKS[k]) force[i] += f->E[k][i] * f->mean[k];
  }
  return 0;
}

static int motion(const double *folded, const waves *w, long sample, const double *q, const double *qd, const double *tau,
                  const unsigned char *closed, double h, int sticking, double *qdd, double *multiplier, double *c, double *cd,
                  unsigned char *held) {
  equations e;
  latent f;
  affine z;
  double force[NQ], damping[NQ], limit[NQ], stopping[NQ], gain[NQ * SOME(ROWS)], both[NQ + SOME(ROWS)], G[NQ][NQ];
  double forward[NQ], backward[NQ], faster[NQ], free[NQ];
  int status, size, overshoots = 0;
  if ((status = prepare(q, qd, tau, closed, &e, gain)) != 0) return status;
  f.learned = NULL, f.folded = folded ? folded + sample * FOLDED[COMPONENTS] : NULL;
  if ((status = latent_forces(q, qd, tau, &e, gain, 0, &f)) != 0) return status;
  add_waves(w, &e, sample, 0, &f);
  inertial_errors(q, qd, tau, &e, NULL, &f);
  expected_force(&e, tau, force);
  for (int r = 0; r < ROWS; ++r) c[r] = e.contact[r].c, cd[r] = dot(e.contact[r].A, qd, NQ);
  size = maps(&e, gain, FORCEGP_QDD | FORCEGP_MULTIPLIER, &z);
  if (sticking) { /* Q(s) with the direction s of friction: Q = (Q(1) + Q(-1)) / 2 - F s */
    double one[NQ], minus[NQ], way[NQ];
    for (int i = 0; i < NQ; ++i) one[i] = 1.0, minus[i] = -1.0, way[i] = qd[i] < 0.0 ? -1.0 : 1.0;
    if ((status = slide(q, qd, tau, w, sample, way, NUDGE, gain, &e, &f, faster)) != 0) return status;
    if ((status = slide(q, qd, tau, w, sample, one, 0.0, gain, &e, &f, forward)) != 0) return status;
    if ((status = slide(q, qd, tau, w, sample, minus, 0.0, gain, &e, &f, backward)) != 0) return status;
    for (int k = 0; k < COMPONENTS; ++k)
      if (STICKS[k]) f.mean[k] = 0.0;
    for (int i = 0; i < NQ; ++i) {
      limit[i] = 0.5 * (backward[i] - forward[i]);
      damping[i] = fmax(way[i] * ((way[i] < 0.0 ? backward[i] : forward[i]) - faster[i]) / NUDGE, 0.0);
      force[i] += 0.5 * (forward[i] + backward[i]) - MEAN_TERMS[2] * e.Q_D[i];
      force[i] += fmax(-limit[i], 0.0) * tanh(qd[i] / NEAR_REST), limit[i] = fmax(limit[i], 0.0);
    }
  }
  read_mean(&z, &f, force, size, both);
  if (sticking) {
    double first[NQ];
    memcpy(G, z.B_Q, sizeof G), memcpy(free, both, sizeof free), memcpy(first, both, sizeof first);
    for (int i = 0; i < NQ; ++i) {
      overshoots |= h * G[i][i] * damping[i] > 1.0;
      stopping[i] = -(fabs(qd[i]) > STILL ? qd[i] : 0.0) / fmax(h, INSTANT);
    }
    if (overshoots) { /* (1 + h G D)^-1 (qdd, G): friction at the end of the step */
      double A[NQ][NQ], B[NQ][NQ + 1];
      for (int i = 0; i < NQ; ++i)
        for (int j = 0; j < NQ; ++j)
          A[i][j] = (i == j ? 1.0 : 0.0) + G[i][j] * h * damping[j], B[i][j] = G[i][j], B[i][NQ] = free[i];
      solve(A, B, NQ + 1);
      for (int i = 0; i < NQ; ++i) memcpy(G[i], B[i], sizeof G[i]), free[i] = B[i][NQ];
    }
    if (!dry_friction(free, G, limit, stopping, force, held)) return FORCEGP_NO_FRICTION;
    for (int i = 0; i < NQ; ++i) forward[i] = force[i];
    for (int i = 0; overshoots && i < NQ; ++i) force[i] -= h * damping[i] * (free[i] + dot(G[i], forward, NQ));
    for (int a = 0; a < size; ++a) both[a] += dot(z.B_Q[a], force, NQ);
    for (int i = 0; i < NQ; ++i) both[i] = held[i] ? stopping[i] : both[i];
  }
  memcpy(qdd, both, sizeof(double) * NQ), memcpy(multiplier, both + NQ, sizeof(double) * ROWS);
  return 0;
}

/* the motion at `count` states, `run` for each sample, over steps h; NaN if a state is not finite. Returns the first
 * other error */
#ifdef __cplusplus
extern "C"
#endif
int forcegp_motions(const double *folded, const waves *w, long count, long run, const double *q, const double *qd,
                    const double *tau, const unsigned char *closed, const double *h, int sticking, double *qdd,
                    double *multiplier, double *c, double *cd, unsigned char *held) {
  for (long i = 0; i < count; ++i) {
    const int status =
        motion(folded, w, i / run, q + i * NQ, qd + i * NQ, tau + i * NQ, closed + i * CONTACTS, h[i], sticking, qdd + i * NQ,
               multiplier + i * ROWS, c + i * ROWS, cd + i * ROWS, held + i * NQ);
    if (status == FORCEGP_NOT_FINITE) {
      for (int j = 0; j < NQ; ++j) qdd[i * NQ + j] = NAN, held[i * NQ + j] = 0;
      for (int r = 0; r < ROWS; ++r) multiplier[i * ROWS + r] = c[i * ROWS + r] = cd[i * ROWS + r] = NAN;
    } else if (status)
      return status;
  }
  return 0;
}
