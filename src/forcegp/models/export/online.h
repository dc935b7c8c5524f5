/* What is learned online. It belongs to the caller; threads that predict while another one learns need a copy. */
#define FORCEGP_FUNCTIONS @functions@
struct forcegp_learned {
  double weights[FORCEGP_FUNCTIONS];                               /* mean of the weights of all functions */
  double folded[@folded@];                                         /* the same of kernels and features */
  double root[FORCEGP_FUNCTIONS * (FORCEGP_FUNCTIONS + 1) / 2]; /* K, by rows; their covariance is K^T K */
  double faded[FORCEGP_FUNCTIONS];                                 /* share of each prior that waits to be renewed */
  double touched[@contacts@];                                      /* 1 for contacts that were closed in a sample */
  int next;                                                        /* the first one that waits */
};
#define FORCEGP_AT_REST 6      /* nothing is learned from a robot at rest, as in a fit */
#define FORCEGP_NO_NOISE 7     /* not one quantity that the fit has measured, and no noise is given */
#define FORCEGP_OUT_OF_RANGE 8 /* a factor is not between 0 and 1, or there is no such prior */
void forcegp_begin(forcegp_learned *learned); /* what the fit has learned */

/* Learn from one sample of a quantity such as FORCEGP_QDD; mean and covariance are those of a fit with it at once.
 * `noise` are the standard deviations of what was measured; NULL for those of the fit. */
int forcegp_update(forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                   const unsigned char *closed, unsigned quantity, const double *measured, const double *noise);

/* Let every sample so far count `factor` times, such as exp(-dt / memory), and renew the prior of `budget` weights, a
 * row each; the others wait. FORCEGP_FUNCTIONS renews all. */
int forcegp_forget(forcegp_learned *learned, double factor, int budget);

/* Let the forces of one prior drift towards the prior, with correlation `factor`: @priors@ */
int forcegp_drift(forcegp_learned *learned, int prior, double factor);

