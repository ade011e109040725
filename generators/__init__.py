"""Scenes and the solvers behind them: every dataset of the benchmark is made here, from nothing."""
