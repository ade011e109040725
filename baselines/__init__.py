"""The competitors: step-wise simulators, ablations, and trivial baselines that every model must beat."""
