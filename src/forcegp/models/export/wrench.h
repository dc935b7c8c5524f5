/* External wrench on the frame @frame@ about its point (@point@) m, estimated from the state and accelerations: the wrench
 * exerted by the environment in addition to the learned forces and the closed contacts. The covariance includes the noise
 * of torques and accelerations.
 *
 * learned, count   as in forcegp_predict_learned
 * qdd              FORCEGP_JOINTS accelerations
 * qdd_std          FORCEGP_JOINTS standard deviations of their noise; NULL means those of the fit
 * mean             mean of the components @axes@ in @reference@ axes
 * covariance       FORCEGP_WRENCH x FORCEGP_WRENCH numbers; NULL if it is not needed, which takes the same time
 * jacobian         FORCEGP_WRENCH x 4 FORCEGP_JOINTS numbers, row by row: derivatives of the mean with respect to q, qd, tau
 *                  and qdd, by fourth-order differences of 16 FORCEGP_JOINTS estimates; NULL if not needed
 */
#define FORCEGP_WRENCH @components@
int forcegp_external_wrench(const forcegp_learned *learned, long count, const double *q, const double *qd, const double *tau,
                            const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                            double *covariance, double *beyond, double *jacobian);

