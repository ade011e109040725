"""Solvers that know no scene: energies, sparse linear algebra, Newton's method, load stepping."""
