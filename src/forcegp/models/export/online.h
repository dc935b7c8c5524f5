/* The online state. It belongs to the caller; threads that predict while another thread learns need a copy. */
#define FORCEGP_FUNCTIONS @functions@
struct forcegp_learned {
  double weights[FORCEGP_FUNCTIONS];                               /* mean of the weights of all functions */
  double folded[@folded@];                                         /* the same of kernels and features */
  double root[FORCEGP_FUNCTIONS * (FORCEGP_FUNCTIONS + 1) / 2]; /* K, by rows; their covariance is K^T K */
  double faded[FORCEGP_FUNCTIONS];                                 /* share of each prior that waits to be renewed */
  double touched[@contacts@];                                      /* 1 for contacts that were closed in a sample */
  int next;                                                        /* the first one that waits */
};
#define FORCEGP_AT_REST 6      /* as in a fit, nothing is learned while the robot is at rest */
#define FORCEGP_NO_NOISE 7     /* the fit contains no measurements of the quantity, and no noise is given */
#define FORCEGP_OUT_OF_RANGE 8 /* a factor is not between 0 and 1, or the prior does not exist */
void forcegp_begin(forcegp_learned *learned); /* initialise with the state of the fit */

/* Learn from one sample of a quantity such as FORCEGP_QDD; the result is that of a fit that includes the sample.
 * `noise` contains the standard deviations of the measured values; NULL means those of the fit. */
int forcegp_update(forcegp_learned *learned, const double *q, const double *qd, const double *tau,
                   const unsigned char *closed, unsigned quantity, const double *measured, const double *noise);

/* Multiply the weight of all previous samples by `factor`, such as exp(-dt / memory), and renew the prior of `budget`
 * weights, at the cost of one row each; the others are renewed in later calls. FORCEGP_FUNCTIONS renews all. */
int forcegp_forget(forcegp_learned *learned, double factor, int budget);

/* Let the forces of one prior drift towards the prior, with correlation `factor`: @priors@ */
int forcegp_drift(forcegp_learned *learned, int prior, double factor);

