"""The program ``ins_node``, of which Ctrl-C while its imports are loaded is a line, too."""

from __future__ import annotations

from hybrid_ins.ros.node import main

if __name__ == "__main__":
    raise SystemExit(main())
