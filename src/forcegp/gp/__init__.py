"""Gaussian processes for latent components: kernels, likelihoods, exact and sparse posteriors, samples."""
