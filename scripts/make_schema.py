"""Write the JSON Schema of the problem file from the models that read it: python scripts/make_schema.py"""

from __future__ import annotations

import json
from pathlib import Path

from tolnet.model.problem import problem_schema

TARGET = Path(__file__).parents[1] / "src/tolnet/model/problem.schema.json"

if __name__ == "__main__":
    TARGET.write_text(json.dumps(problem_schema(), indent=2) + "\n", encoding="utf-8")
    print(TARGET)
