"""Parts of `benchmarks/inference.py`: what is timed, and how."""
