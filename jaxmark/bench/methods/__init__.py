"""Methods of the literature, one a module, as the benchmark takes them."""
