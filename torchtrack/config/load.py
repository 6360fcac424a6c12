"""From a YAML file and the command line to settings, with every mistake told at once.

What counts, from weakest to strongest: defaults, preset, file, command line.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from torchtrack.config.explain import explained
from torchtrack.config.merge import merged, nested
from torchtrack.config.settings import CommandLineText, Settings
from torchtrack.core.files import is_file, read_bytes
from torchtrack.core.yaml_text import load_document
from torchtrack.errors import ConfigError, MissingFileError

S = TypeVar("S", bound=BaseModel)


def read_yaml(path: Path) -> dict[str, Any]:
    """The mapping that a YAML file holds; an empty file is an empty mapping.

    Raises:
        MissingFileError: if the file is not there.
        ConfigError: if it is not YAML, holds something other than a mapping, or a key twice.
    """
    if not is_file(path):
        raise MissingFileError(f"no config file at {path}. Check the path; examples are in the folder configs/.")
    try:
        values = load_document(read_bytes(path, "config file", "text_bytes").decode("utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from error
    if values is not None and not isinstance(values, dict):
        raise ConfigError(f"{path}: expected settings as 'name: value' lines, got a {type(values).__name__}.")
    if strange := [key for key in values or {} if not isinstance(key, str)]:
        raise ConfigError(f"{path}: the names of settings are text, got {strange[0]!r}. Put it in quotes, or correct it.")
    return values or {}


def typed(text: str) -> Any:
    """A value typed on the command line, read as YAML: ``3`` is a number, ``[1, 2]`` a list, ``null`` nothing."""
    try:
        value = load_document(text)
    except yaml.YAMLError:
        value = text
    return _from_command_line(value)


def _from_command_line(value: Any) -> Any:
    """Mark every text, so that paths among them are taken from the working folder."""
    if isinstance(value, str):
        return CommandLineText(value)
    if isinstance(value, list):
        return [_from_command_line(item) for item in value]
    if isinstance(value, dict):
        return {key: _from_command_line(item) for key, item in value.items()}
    return value


def load(settings: type[S], path: Path | None = None, overrides: Mapping[str, Any] | None = None) -> S:
    """Settings from a YAML file, with ``overrides`` (dotted key to value) laid over them.

    Relative paths in the file are relative to its folder; see :class:`CommandLineText` for those in overrides.

    Raises:
        MissingFileError: if the file is not there.
        ConfigError: with all mistakes of file and overrides at once.
    """
    overrides = overrides or {}
    values = merged(read_yaml(path) if path else {}, nested(overrides))
    try:
        return settings.model_validate(values, context={"folder": path.resolve().parent if path else None})
    except ValidationError as error:
        raise ConfigError(explained(error, settings, str(path) if path else None, overrides.keys())) from error


def as_yaml(settings: Settings) -> str:
    """Settings as YAML that :func:`load` reads back to the same."""
    return yaml.safe_dump(settings.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=120)
