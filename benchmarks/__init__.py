"""Each benchmark measures tolnet against a named peer, both in the same run: `python -m benchmarks [NAME ...]`."""
