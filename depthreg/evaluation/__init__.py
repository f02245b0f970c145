"""How a network is judged: known misalignments, scores beside the baselines, curves and the worst frames."""
