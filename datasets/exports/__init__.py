"""Trajectories in the formats of other tools; `docs/export.md` says what each holds."""
