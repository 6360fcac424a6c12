"""Names of the parts that can be measured: each is a module beside this one."""

from typing import Literal

Part = Literal["pipeline", "lost", "stages", "solver", "surface", "flow", "io", "sim", "scaling", "peers"]
