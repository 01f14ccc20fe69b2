"""The depth law of the 2018 method, fitted to measured distances."""
