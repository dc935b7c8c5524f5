/* Posterior mean and its Jacobian for qdd, multiplier, contact force and joint friction, including undetermined ones.
 *
 * jacobian     d x 3 FORCEGP_JOINTS numbers, row by row: derivatives with respect to q, then qd, then tau
 */
int forcegp_jacobian(const double *q, const double *qd, const double *tau, const unsigned char *closed,
                     unsigned quantities, double *mean, double *jacobian);

/* The same at `count` states, one after the other; returns the first error. */
int forcegp_jacobian_many(long count, const double *q, const double *qd, const double *tau, const unsigned char *closed,
                          unsigned quantities, double *mean, double *jacobian);

