"""The base of all settings, and paths that know what they are relative to."""

import os
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict

_LONGEST_NAME = 255


class Settings(BaseModel):
    """Frozen, and a name that is not known is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class CommandLineText(str):
    """Text typed on the command line: a path in it is relative to the working folder, not to the config file's."""

    __slots__ = ()


def absolute_path(value: Any, info: Any) -> Any:
    """An absolute path: ``~`` and ``$VARIABLES`` expanded, relative to ``context["folder"]``, else to the working folder.

    ``info`` is pydantic's ValidationInfo, a protocol that cannot be checked at run time.
    """
    if not isinstance(value, str | Path):
        return value
    try:
        expanded = os.path.expandvars(Path(value).expanduser())
    except RuntimeError as error:
        raise ValueError("nobody of the name after ~ has a home folder") from error
    if missing := re.findall(r"\$\{?(\w+)", expanded):
        raise ValueError(f"the environment variable {missing[0]} is not set")
    folder = (info.context or {}).get("folder")
    if "\0" in expanded or max((len(os.fsencode(part)) for part in Path(expanded).parts), default=0) > _LONGEST_NAME:
        raise ValueError(f"no file can have this name (a part of more than {_LONGEST_NAME} bytes, or a zero character)")
    base = Path.cwd() if folder is None or isinstance(value, CommandLineText) else folder
    return Path(os.path.normpath(base / expanded))


ConfigPath = Annotated[Path, BeforeValidator(absolute_path)]
