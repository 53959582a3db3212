"""Fetch the data that are not shipped into ``validation/fetched``, and check their SHA-256."""

from __future__ import annotations

import hashlib
import json
import sys
import urllib.request
from pathlib import Path

HERE = Path(__file__).parent
FETCHED = HERE / "fetched"


def main() -> int:
    """Fetch what is missing; 1 if a file is not the one that was compared."""
    FETCHED.mkdir(exist_ok=True)
    wrong = []
    for source in json.loads((HERE / "sources.json").read_text()).values():
        for name, file in source["files"].items():
            target = FETCHED / name
            if not target.exists():
                with urllib.request.urlopen(source["address"] + file["path"], timeout=60) as answer:
                    target.write_bytes(answer.read())
            if hashlib.sha256(target.read_bytes()).hexdigest() != file["sha256"]:
                wrong.append(name)
    print("\n".join(f"{name}: another digest than in sources.json" for name in wrong) or "all files are there")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
