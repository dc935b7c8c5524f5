/* Forces and accelerations of a robot with learned forces, written by forcegp.
 *
 * M qdd = Q + Q_z + A^T lambda and A qdd = b. All units are SI, angles in radians, vectors in world axes.
 * No function allocates memory or has state of its own. All are reentrant, and their run time is bounded.
 *
 * Joints, in order: @joints@
 * Contacts, in order: @touching@
 */
#ifndef FORCEGP_H
#define FORCEGP_H

#ifdef __cplusplus
extern "C" {
#endif

#define FORCEGP_JOINTS @nq@
#define FORCEGP_CONTACTS @contacts@

/* Quantities, which can be combined with |. Mean and covariance contain them in this order. */
@bits@

/* Error codes; 0 means success */
#define FORCEGP_NOT_FINITE 1  /* a state is not finite; nothing is written */
#define FORCEGP_JAMMED 2      /* the friction coefficient of a contact is so large that it jams */
#define FORCEGP_UNRESOLVED 3  /* a variance is below rounding error, or a covariance has a negative eigenvalue */
#define FORCEGP_NO_INERTIA 4  /* the mass matrix is not positive definite */
#define FORCEGP_NO_JACOBIAN 5 /* the quantity has no Jacobian, or the closed contacts are not independent */
#define FORCEGP_OVERFLOW 9    /* a result is not finite */
#define FORCEGP_UNDETERMINED 11 /* results are written, but some contact forces are not determined: NaN for contacts that are
                                 * never closed in the data or cannot move, and wide error bars for shared loads */

/* Number d of components of the given quantities. */
int forcegp_size(unsigned quantities);

/* Posterior mean and covariance of quantities at one state.
 *
 * q, qd, tau   FORCEGP_JOINTS positions, velocities and motor torques
 * closed       FORCEGP_CONTACTS flags of the closed contacts; NULL means all
 * quantities   such as FORCEGP_QDD | FORCEGP_MULTIPLIER
 * noise        whether the covariance is that of a measurement, including the noise of torques and sensors
 * mean         d numbers
 * covariance   d x d numbers, row by row; NULL if it is not needed, which takes less time
 * beyond       FORCEGP_JOINTS distances by which speeds and torques exceed the training data, in standard
 *              deviations of these data, 0 inside; above 3, error bars are extrapolated. NULL if not needed
 */
int forcegp_predict(const double *q, const double *qd, const double *tau, const unsigned char *closed,
                    unsigned quantities, int noise, double *mean, double *covariance, double *beyond);

/* The same at `count` states, with the online state, or with that of the fit if `learned` is NULL. Returns the first error
 * or, if there is none, FORCEGP_UNDETERMINED if it applies to any state. */
typedef struct forcegp_learned forcegp_learned;
int forcegp_predict_learned(const forcegp_learned *learned, long count, const double *q, const double *qd,
                            const double *tau, const unsigned char *closed, unsigned quantities, int noise, double *mean,
                            double *covariance, double *beyond);

@online@@wrench@@contact_force@/* Mass matrix M, and the rows of A for all contacts; three planes through a tool give its Jacobian. */
int forcegp_equations(const double *q, const double *qd, double *M, double *A);

@jacobian@/* Free acceleration M^-1 (force + Q_C + Q_G) of the robot alone. */
void forcegp_forward_dynamics(const double *q, const double *qd, const double *force, double *qdd);

#ifdef __cplusplus
}
#endif
#endif
