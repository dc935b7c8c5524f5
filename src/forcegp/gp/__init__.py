"""Gaussian processes of latent components: kernels, likelihoods, exact and sparse posteriors, draws."""
