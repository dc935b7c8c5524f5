/* Compares @name@.c with the values computed by forcegp; returns 0 if all agree. */
#include <math.h>
#include <stdio.h>
#include "@name@.h"

@tables@

/* the largest difference so far; a reduced covariance may be wider, never narrower, and NaN stands for what is not
 * determined */
static double worse(double most, double ours, double theirs, double scale, int reduced) {
  if (isnan(ours) != isnan(theirs)) return INFINITY;
  return reduced && ours > theirs ? most : fmax(most, fabs(ours - theirs) / scale);
}

static double in_mean = 0.0, in_covariance = 0.0;

/* largest difference in the mean, in units of max(|mean|, std), and in its covariance; these units are at least ZERO
 * times those of the largest component */
static void compare(int n, const @real@ *m, const @real@ *C, const double *mean, const double *covariance) {
  double std[D + 6], size[D + 6], most = 0.0, widest = 0.0;
  for (int a = 0; a < n; ++a) {
    std[a] = sqrt(covariance[a * n + a]), widest = fmax(widest, std[a]);
    size[a] = fmax(fabs(mean[a]), std[a]), most = fmax(most, size[a]);
  }
  for (int a = 0; a < n; ++a) std[a] = fmax(std[a], ZERO * widest), size[a] = fmax(size[a], ZERO * most);
  for (int a = 0; a < n; ++a) {
    in_mean = worse(in_mean, m[a], mean[a], size[a], 0);
    for (int b = 0; b < n; ++b)
      if (a == b || !REDUCED)
        in_covariance = worse(in_covariance, C[a * n + b], covariance[a * n + b], std[a] * std[b], REDUCED);
  }
}

int main(void) {
  double in_slopes = 0.0;
  static @real@ J[SLOPES];
  @real@ m[D], C[D * D], beyond[@NAME@_JOINTS];
  if (@name@_size(WANTED) != D) return 2;
  for (int i = 0; i < STATES; ++i) {
    double most = 0.0;
#ifdef JACOBIANS
    const int second = @name@_jacobian(q[i], qd[i], tau[i], closed[i], @NAME@_QDD | @NAME@_MULTIPLIER, m, J);
#else
    const int second = @NAME@_NO_JACOBIAN;
#endif
    int status = @name@_predict(q[i], qd[i], tau[i], closed[i], WANTED, 0, m, C, beyond);
    if (status == @NAME@_UNDETERMINED) status = 0;
    if (status == 0) compare(D, m, C, mean[i], covariance[i]);
#ifdef @NAME@_WRENCH
    if (status == 0)
      status = @name@_external_wrench(NULL, 1, q[i], qd[i], tau[i], qdd[i], closed[i], NULL, m, C, beyond, NULL);
    if (status == 0 && !REDUCED) compare(@NAME@_WRENCH, m, C, wrench[i], wrench_covariance[i]);
#endif
#ifdef CONTACT_FORCE
    if (status == 0)
      status = @name@_contact_force(NULL, 1, q[i], qd[i], tau[i], qdd[i], closed[i], NULL, m, C, beyond);
    if (status == 0 && !REDUCED) compare(3 * @NAME@_CONTACTS, m, C, contact_force[i], contact_force_covariance[i]);
#endif
    if (status != 0 || (second != 0 && second != @NAME@_NO_JACOBIAN)) {
      printf("state %d: errors %d, %d\n", i, status, second);
      return 1;
    }
    for (int a = 0; a < SLOPES; ++a) most = fmax(most, fabs(slopes[i][a]));
    for (int a = 0; second == 0 && a < SLOPES; ++a) in_slopes = fmax(in_slopes, fabs(J[a] - slopes[i][a]) / most);
  }
  printf("largest difference in units of max(|mean|, std): %.2g; of a variance: %.2g\n", in_mean, in_covariance);
  printf("of a Jacobian, in units of its largest entry: %.2g\n", in_slopes);
  return in_mean <= TOLERANCE && in_covariance <= 2.0 * TOLERANCE && in_slopes <= 100.0 * TOLERANCE ? 0 : 1;
}
