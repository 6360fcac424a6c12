"""YAML of people and tools, read so that no text costs more than it should, and every fault is a ``yaml.YAMLError``.

Beyond what ``yaml.SafeLoader`` checks, this refuses: a key that is given twice, a value that holds itself, more nesting or more
values than :mod:`torchtrack.core.limits` allow (an alias counts as what it stands for, so that aliases of aliases cannot multiply), and
texts that cannot be encoded. A scalar that looks like a date or a number, but is none, is told with its place.
"""

from collections.abc import Hashable
from typing import Any

import yaml

from torchtrack.core.limits import current_limits

# What the constructors of the library raise for scalars that their patterns let through, such as 2001-99-99.
_BAD_SCALAR = (ValueError, OverflowError, KeyError, AttributeError, TypeError)


class LimitedLoader(yaml.SafeLoader):
    """A ``SafeLoader`` with limits; see the module."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self._depth, self._values, self._limits = 0, 0, current_limits()
        # What a node and all below it amount to, aliases expanded. Nodes are held, so that no number of one is used again.
        self._weights: dict[yaml.Node, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """The next node, within the limits."""
        event: Any = self.peek_event()
        if self.check_event(yaml.AliasEvent):
            node = super().compose_node(parent, index)
            weight = self._weights.get(node) if node is not None else 0
            if weight is None:
                raise yaml.composer.ComposerError(None, None, f"'{event.anchor}' stands within itself", event.start_mark)
            self._count(weight, event)
            return node
        before = self._values
        self._count(1, event)
        self._depth += 1
        if self._depth > self._limits.text_depth:
            message = f"nested more than {self._limits.text_depth} levels deep; the setting limits.text_depth raises this"
            raise yaml.composer.ComposerError(None, None, message, event.start_mark)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if node is not None:
            self._weights[node] = self._values - before
        return node

    def _count(self, values: int, event: Any) -> None:
        self._values += values
        if self._values > self._limits.text_nodes:
            message = f"more than {self._limits.text_nodes} values, with aliases written out; the setting limits.text_nodes raises this"
            raise yaml.composer.ComposerError(None, None, message, event.start_mark)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """What a node stands for.

        Raises:
            yaml.YAMLError: also for a scalar that its kind does not allow.
        """
        try:
            return super().construct_object(node, deep)
        except _BAD_SCALAR as error:
            kind = node.tag.rpartition(":")[2]
            # What cannot be encoded could not be shown either.
            shown = str(node.value)[:60].encode("utf-8", "replace").decode()
            message = f"'{shown}' is no {kind} ({error}); put text in quotes"
            raise yaml.constructor.ConstructorError(None, None, message, node.start_mark) from error

    # The library hands on what is no mapping too, and says so itself.
    def construct_mapping(self, node: yaml.MappingNode | Any, deep: bool = False) -> dict[Hashable, Any]:
        """A mapping whose keys differ."""
        seen: set[Any] = set()
        for key_node, _ in node.value if isinstance(node, yaml.MappingNode) else ():
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if isinstance(key, Hashable) and key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"the key '{key}' is given twice", key_node.start_mark)
            if isinstance(key, Hashable):
                seen.add(key)
        return super().construct_mapping(node, deep)


def _text(loader: LimitedLoader, node: Any) -> str:
    text = str(loader.construct_scalar(node))
    # Escapes can write what no file name and no output can hold.
    text.encode()
    if "\0" in text:
        raise ValueError("it holds a zero character")
    return text


LimitedLoader.add_constructor("tag:yaml.org,2002:str", _text)


def load_documents(text: str, loader: type[LimitedLoader] = LimitedLoader) -> list[Any]:
    """What each document of a YAML text holds.

    Raises:
        yaml.YAMLError: if it is no YAML, or beyond the limits.
    """
    most = current_limits().text_bytes
    if len(text) > most:
        raise yaml.YAMLError(f"{len(text)} characters are more than the {most} that are read; the setting limits.text_bytes raises this")
    try:
        return list(yaml.load_all(text, Loader=loader))
    except (ValueError, OverflowError) as error:
        # An escape of a character that there is not.
        raise yaml.YAMLError(str(error)) from error


def load_document(text: str, loader: type[LimitedLoader] = LimitedLoader) -> Any:
    """What a YAML text of one document holds; None for none.

    Raises:
        yaml.YAMLError: if it is no YAML, holds several documents, or is beyond the limits.
    """
    documents = load_documents(text, loader)
    if len(documents) > 1:
        raise yaml.YAMLError(f"{len(documents)} documents, where one is expected; they are parted by '---'")
    return documents[0] if documents else None
