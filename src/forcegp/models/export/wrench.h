/* External wrench on the frame @frame@ about the point (@point@) m of it, from accelerations beside the state: the wrench of the
 * environment beyond the learned forces and the closed contacts, with the covariance of an estimate (noise of torques
 * and accelerations included).
 *
 * learned, count   as in forcegp_predict_learned
 * qdd              FORCEGP_JOINTS accelerations
 * qdd_std          FORCEGP_JOINTS standard deviations of their noise; NULL for that of the fit
 * mean             of the components @axes@ in @reference@ axes
 * covariance       FORCEGP_WRENCH x FORCEGP_WRENCH numbers; NULL if it is not needed, which costs the same
 * jacobian         FORCEGP_WRENCH x 4 FORCEGP_JOINTS numbers, row by row: derivatives of the mean by q, qd, tau and qdd as
 *                  differences of the fourth order, 16 FORCEGP_JOINTS estimates; NULL if not needed
 */
#define FORCEGP_WRENCH @components@
int forcegp_external_wrench(const forcegp_learned *learned, long count, const double *q, const double *qd, const double *tau,
                            const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                            double *covariance, double *beyond, double *jacobian);

