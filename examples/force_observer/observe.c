/* The force on the tool of a robot with learned forces, with error bars, from a stream of states.
 *
 *     ./observe < states > forces
 *
 * Reads records `state` and writes a `reading` for each. A Kalman filter estimates x = (v, w, eta): the velocity of
 * the joints, the force w on the tool, and the error S^1/2 eta of the learned forces Q ~ N(E Q, S),
 *   v' = v + h M^-1 (E Q + J^T w + S^1/2 eta),  w' = phi w + noise,  eta' = psi eta + noise,
 * from measured velocities; it needs no accelerations. Times are those of one state: of the processor, and on the
 * clock from when the state was sent. */
#define _POSIX_C_SOURCE 200809L
#include <math.h>
#include <stdio.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include "controller.h"
#include "settings.h"

enum { NQ = CONTROLLER_JOINTS, K = 3, N = 2 * NQ + K, W = NQ, ETA = NQ + K };

typedef struct {
  double sent, t, q[NQ], qd[NQ], tau[NQ];
} state;

typedef struct {
  double t, force[K], std[K], beyond, processor, wall, error;
} reading;

static double now(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* A = L L^T in the lower triangle of A, in place; a small multiple of the identity keeps L real */
static void factor(double A[NQ][NQ]) {
  for (int j = 0; j < NQ; ++j)
    for (int i = j; i < NQ; ++i) {
      double sum = A[i][j];
      for (int k = 0; k < j; ++k) sum -= A[i][k] * A[j][k];
      A[i][j] = i == j ? sqrt(fmax(sum, 1e-18)) : sum / A[j][j];
    }
}

/* x = (L L^T)^-1 x */
static void solve(double L[NQ][NQ], double *x) {
  for (int i = 0; i < NQ; ++i) {
    for (int k = 0; k < i; ++k) x[i] -= L[i][k] * x[k];
    x[i] /= L[i][i];
  }
  for (int i = NQ - 1; i >= 0; --i) {
    for (int k = i + 1; k < NQ; ++k) x[i] -= L[k][i] * x[k];
    x[i] /= L[i][i];
  }
}

typedef struct {
  double x[N], P[N][N], F[N][N], drift[NQ]; /* mean, covariance; the step from here: x' = F x + drift h */
  double t;
  int begun;
} filter;

static void advance(filter *f, double h) {
  double FP[N][N], x[N];
  for (int i = 0; i < NQ; ++i)
    for (int j = NQ; j < N; ++j) f->F[i][j] *= h;
  for (int i = NQ; i < N; ++i) {
    const double c = i < ETA ? 0.0 : CORRELATION[i - ETA];
    f->F[i][i] = i < ETA ? exp(-h / LASTS) : fmax((c - h) / (c + h), 0.0);
  }
  for (int i = 0; i < N; ++i) {
    x[i] = i < NQ ? h * f->drift[i] : 0.0;
    for (int j = 0; j < N; ++j) {
      x[i] += f->F[i][j] * f->x[j], FP[i][j] = 0.0;
      for (int k = i; k < N; ++k) FP[i][j] += f->F[i][k] * f->P[k][j]; /* F is upper triangular */
    }
  }
  memcpy(f->x, x, sizeof x);
  for (int i = 0; i < N; ++i)
    for (int j = 0; j < N; ++j) {
      f->P[i][j] = 0.0;
      for (int k = j; k < N; ++k) f->P[i][j] += FP[i][k] * f->F[j][k];
    }
  for (int i = NQ; i < N; ++i) f->P[i][i] += (1.0 - f->F[i][i] * f->F[i][i]) * (i < ETA ? PRIOR * PRIOR : 1.0);
}

static void correct(filter *f, const double *qd) {
  for (int j = 0; j < NQ; ++j) {
    const double variance = f->P[j][j] + VELOCITY_NOISE[j] * VELOCITY_NOISE[j], gap = qd[j] - f->x[j];
    double row[N];
    memcpy(row, f->P[j], sizeof row);
    for (int i = 0; i < N; ++i) {
      f->x[i] += row[i] / variance * gap;
      for (int k = 0; k < N; ++k) f->P[i][k] -= row[i] * row[k] / variance;
    }
  }
}

/* the step from a state: M^-1 (J^T, S^1/2) and M^-1 E Q. Errors of the inertia count at the acceleration that the
 * model expects, which a force on the tool changes; S is read where there is none, so that they count by weight */
static int look(filter *f, const state *s, double *beyond) {
  static const unsigned char open[CONTROLLER_CONTACTS] = {0};
  double M[NQ][NQ], J[K][NQ], S[NQ][NQ], force[NQ], column[NQ], tau[NQ], far[NQ], farther[NQ];
  int error;
  memset(f->F, 0, sizeof f->F), memset(f->drift, 0, sizeof f->drift);
  for (int i = 0; i < NQ; ++i) f->F[i][i] = 1.0;
  error = controller_equations(s->q, s->qd, &M[0][0], &J[0][0]);
  if (error) return error;
  error = controller_predict(s->q, s->qd, s->tau, open, CONTROLLER_JOINT_FORCE, 1, force, NULL, farther);
  for (int i = 0; i < NQ; ++i) tau[i] = s->tau[i] - force[i];
  error = error ? error : controller_predict(s->q, s->qd, tau, open, CONTROLLER_JOINT_FORCE, 1, column, &S[0][0], far);
  if (error) return error;
  for (int i = 0; i < NQ; ++i) /* the torque itself is farther from those of the training */
    S[i][i] += GROWTH[i] * GROWTH[i] * fmax(farther[i] * farther[i] - far[i] * far[i], 0.0);
  factor(M), factor(S);
  for (int j = NQ; j < N; ++j) {
    for (int i = 0; i < NQ; ++i) column[i] = j < ETA ? J[j - W][i] : i < j - ETA ? 0.0 : S[i][j - ETA];
    solve(M, column);
    for (int i = 0; i < NQ; ++i) f->F[i][j] = column[i];
  }
  solve(M, force);
  memcpy(f->drift, force, sizeof force);
  *beyond = 0.0;
  for (int i = 0; i < NQ; ++i) *beyond = fmax(*beyond, farther[i]);
  return 0;
}

static int whole(int file, void *buffer, size_t size) {
  for (size_t done = 0; done < size;) {
    const ssize_t count = read(file, (char *)buffer + done, size - done);
    if (count <= 0) return 0;
    done += (size_t)count;
  }
  return 1;
}

int main(void) {
  static filter f;
  state s;
  while (whole(STDIN_FILENO, &s, sizeof s)) {
    const double began = now(CLOCK_PROCESS_CPUTIME_ID);
    reading r = {0};
    if (f.begun)
      advance(&f, s.t - f.t);
    else {
      for (int i = 0; i < N; ++i) f.P[i][i] = i < NQ ? 1.0 : i < ETA ? PRIOR * PRIOR : 1.0;
      f.begun = 1;
    }
    correct(&f, s.qd);
    r.t = f.t = s.t;
    r.error = look(&f, &s, &r.beyond);
    for (int i = 0; i < K; ++i) r.force[i] = f.x[W + i], r.std[i] = sqrt(f.P[W + i][W + i]);
    r.processor = now(CLOCK_PROCESS_CPUTIME_ID) - began;
    r.wall = now(CLOCK_MONOTONIC) - s.sent;
    if (write(STDOUT_FILENO, &r, sizeof r) != (ssize_t)sizeof r) return 1;
  }
  return 0;
}
