"""Numbers that the paper gives and that our models are held against.

Source: "Context-aware Learned Mesh-based Simulation via Trajectory-Level Meta-Learning" (M3GN), appendix, table
"Runtime, memory, and parameter comparison of all methods on the four benchmark tasks".
"""

PARAMETERS: dict[str, dict[str, int]] = {  # by task and model, under the preset "paper"
    "deformable_block": {"m3gn": 2_542_847, "mgn": 1_259_394, "egno": 1_000_026, "mango": 2_990_082},
    "sheet_deformation": {"m3gn": 2_546_206, "mgn": 1_259_779, "egno": 999_258, "mango": 2_990_211},
    "tissue_manipulation": {"m3gn": 2_547_614, "mgn": 1_259_907, "egno": 1_000_794, "mango": 2_990_723},
    "mixed_objects": {"m3gn": 2_545_950, "mgn": 1_259_651, "egno": 999_130, "mango": 2_990_083},
}


def published_parameters(task: str, model: str, preset: str) -> int | None:
    """The number of parameters that the paper gives; None where it gives none."""
    return PARAMETERS.get(task, {}).get(model) if preset == "paper" else None
