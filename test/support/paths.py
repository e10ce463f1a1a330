"""Where the project and its recordings lie."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
