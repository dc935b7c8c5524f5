/* Forces of the environment on the contacts, estimated from the state and accelerations, as the external wrench is. The
 * forces of all closed contacts are unknown; normal forces are free, and tangential ones have the learned size. The covariance
 * includes the noise of torques and accelerations. Friction with memory is not tracked.
 *
 * learned, count   as in forcegp_predict_learned
 * qdd              FORCEGP_JOINTS accelerations
 * qdd_std          FORCEGP_JOINTS standard deviations of their noise; NULL means those of the fit
 * mean             3 FORCEGP_CONTACTS numbers in world axes, contact by contact, zero for open contacts
 * covariance       3 FORCEGP_CONTACTS x 3 FORCEGP_CONTACTS numbers; NULL if it is not needed, which takes the same time
 */
int forcegp_contact_force(const forcegp_learned *learned, long count, const double *q, const double *qd, const double *tau,
                          const double *qdd, const unsigned char *closed, const double *qdd_std, double *mean,
                          double *covariance, double *beyond);

