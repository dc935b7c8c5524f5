/* Compares @name@.c with the values of forcegp; 0 if all agree. */
#include <math.h>
#include <stdio.h>
#include "@name@.h"

@tables@

/* a reduced covariance may be wider, never narrower */
static double differs(double ours, double theirs, double scale) {
  return REDUCED && ours > theirs ? 0.0 : fabs(ours - theirs) / scale;
}

int main(void) {
  double in_mean = 0.0, in_covariance = 0.0, in_slopes = 0.0, m[D], C[D * D], beyond[@NAME@_JOINTS], J[SLOPES];
  if (@name@_size(WANTED) != D) return 2;
  for (int i = 0; i < STATES; ++i) {
    double std[D], size[D], most = 0.0, widest = 0.0;
    const int second = @name@_jacobian(q[i], qd[i], tau[i], closed[i], @NAME@_QDD | @NAME@_MULTIPLIER, m, J);
    const int status = @name@_predict(q[i], qd[i], tau[i], closed[i], WANTED, 0, m, C, beyond);
    if (status != 0 || (second != 0 && second != @NAME@_NO_JACOBIAN)) {
      printf("state %d: errors %d, %d\n", i, status, second);
      return 1;
    }
    for (int a = 0; a < SLOPES; ++a) most = fmax(most, fabs(slopes[i][a]));
    for (int a = 0; second == 0 && a < SLOPES; ++a) in_slopes = fmax(in_slopes, fabs(J[a] - slopes[i][a]) / most);
    most = 0.0;
    for (int a = 0; a < D; ++a) {
      std[a] = sqrt(covariance[i][a * D + a]), widest = fmax(widest, std[a]);
      size[a] = fmax(fabs(mean[i][a]), std[a]), most = fmax(most, size[a]);
    }
    /* what is below ZERO of the largest component is compared with that */
    for (int a = 0; a < D; ++a) std[a] = fmax(std[a], ZERO * widest), size[a] = fmax(size[a], ZERO * most);
    for (int a = 0; a < D; ++a) {
      in_mean = fmax(in_mean, fabs(m[a] - mean[i][a]) / size[a]);
      for (int b = 0; b < D; ++b)
        if (a == b || !REDUCED)
          in_covariance = fmax(in_covariance, differs(C[a * D + b], covariance[i][a * D + b], std[a] * std[b]));
    }
  }
  printf("largest difference in units of max(|mean|, std): %.2g; of a variance: %.2g\n", in_mean, in_covariance);
  printf("of a Jacobian, in units of its largest entry: %.2g\n", in_slopes);
  return in_mean <= TOLERANCE && in_covariance <= 2.0 * TOLERANCE && in_slopes <= 100.0 * TOLERANCE ? 0 : 1;
}
