"""Prove: stability, convergence, observability and enclosures, and the checker of such proofs, will live here."""
