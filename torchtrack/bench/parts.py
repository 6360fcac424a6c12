"""Names of the parts that can be measured: each is a module beside this one."""

from typing import Literal

Part = Literal["pipeline", "presets", "lost", "stages", "graphs", "solver", "surface", "flow", "io", "sim", "scaling", "peers"]
