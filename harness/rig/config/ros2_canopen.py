"""Rigs from ros2_canopen's bus.yml, which is also the file of Lely's dcfgen.

The file describes a CANopen master and its nodes. The rig has the nodes as emulated controllers.
The master stays what it is: it writes `sdo`, `rpdo`, `tpdo` and the heartbeat time into the nodes
when they boot, and it sends SYNC. The rig therefore needs the node-ID and the EDS of each node, the
bit rate and the SYNC period. Every other key has a note: known keys by their reader, unknown ones
by name.

Sections: `master`, `options`, `defaults` for all nodes, and `nodes`. Without `nodes`, each further
section is a node, as in dcfgen; names that begin with a dot only hold YAML anchors.

Sources: ros2_canopen, user guide, "Configuration Package"; Lely core, dcf-tools, dcfgen.
"""

import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final, final

from motorhil.emulators.canopen.files.eds import EdsError, EdsText, parse_integer, read_eds
from motorhil.frozen import frozen
from motorhil.harness.rig.config.toml import RigError

_SECTIONS: Final = ("options", "master", "defaults", "nodes")
_CONFIG_PATH: Final = "@BUS_CONFIG_PATH@"
_MASTER_USED: Final = frozenset(("node_id", "baudrate", "sync_period", "sync_overflow"))
_MASTER_KNOWN: Final = frozenset(
    (
        *("driver", "package", "namespace", "vendor_id", "product_code", "revision_number"),
        *("serial_number", "heartbeat_multiplier", "heartbeat_consumer", "heartbeat_producer"),
        *("emcy_inhibit_time", "sync_window", "error_behavior", "nmt_inhibit_time", "start"),
        *("start_nodes", "start_all_nodes", "reset_all_nodes", "stop_all_nodes", "boot_time"),
        *("boot_timeout", "container_name", "dcf_path"),
    )
)
_NODE_USED: Final = frozenset(("node_id", "dcf", "num_channels"))
_NODE_KNOWN: Final = frozenset(  # of the master's driver, or written into the node by the master
    (
        *("driver", "package", "namespace", "enable_lazy_load", "dcf_path", "revision_number"),
        *("serial_number", "heartbeat_multiplier", "heartbeat_consumer", "heartbeat_producer"),
        *("error_behavior", "rpdo", "tpdo", "sdo", "boot", "mandatory", "reset_communication"),
        *("software_file", "software_version", "configuration_file", "restore_configuration"),
        *("sdo_timeout_ms", "boot_timeout_ms", "period", "polling", "diagnostics"),
        *("switching_state", "homing_timeout_seconds", "position_mode", "velocity_mode"),
        *("scale_pos_to_dev", "scale_pos_from_dev", "scale_vel_to_dev", "scale_vel_from_dev"),
        *("scale_eff_from_dev", "offset_pos_to_dev", "offset_pos_from_dev"),
        *("channel_names", "channels"),
    )
)
_OPTIONS_KNOWN: Final = frozenset(("dcf_path", "heartbeat_multiplier", "cob_id"))
_NOT_IN_NAMES: Final = re.compile(r"[^A-Za-z0-9_-]+")
_BAUDRATE_KBIT_S: Final = 1000
_NODE_ID_MAX: Final = 127
_DRIVE: Final = ((0x6040, 0), (0x6041, 0))
_IO_NODE: Final = ((0x6000, 1), (0x6200, 1), (0x6411, 1))


@final
@frozen
class _Node:
    """One node that becomes a controller."""

    name: str
    kind: str
    node_id: int
    eds: Path


def rig_of_bus(source: Path, folder: Path) -> tuple[str, list[str]]:
    """Return the text of a rig in `folder` with the nodes of a bus.yml, and notes about it.

    Raises:
        RigError: the file cannot be read, or a section is not usable.
        BusFileError: several sections are not usable.
    """
    return _Bus(source).rig(folder)


@final
class BusFileError(RigError):
    """Several errors of a bus.yml, one a line."""

    def __init__(self, errors: Sequence[RigError]) -> None:
        first = errors[0]
        told = first.file, first.message, first.remedy
        super().__init__(*told, line=first.line, key=first.key)
        self.args: tuple[str] = ("\n".join(map(str, errors)),)


@final
class _Bus:
    """One bus.yml."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self.notes: list[str] = []
        self._errors: list[RigError] = []
        content, self._lines = _yaml(source)
        whole = _section(source, "the file", content)
        self._master = _section(source, "master", whole.get("master", {}))
        self._defaults = _section(source, "defaults", whole.get("defaults", {}))
        self._tell("options", _section(source, "options", whole.get("options", {})), _OPTIONS_KNOWN)
        others = {
            name: section
            for name, section in whole.items()
            if name not in _SECTIONS and not name.startswith(".")
        }
        if "nodes" in whole:
            self._nodes = _named(source, whole["nodes"])
            if others:
                self.notes.append(f"unknown sections, left out: {', '.join(others)}")
        else:
            self._nodes = others

    def rig(self, folder: Path) -> tuple[str, list[str]]:
        """Return the rig and the notes."""
        master_id = self._whole(self._master, "master", "node_id", 0)
        baudrate = self._whole(self._master, "master", "baudrate", _BAUDRATE_KBIT_S)
        self._tell("master", self._master, _MASTER_USED | _MASTER_KNOWN)
        sync = self._sync()
        nodes = list(self._usable_nodes(master_id))
        if not nodes and not self._errors:
            raise RigError(self._source, "no node to emulate", "add a node with node_id and dcf")
        if self._errors:
            raise self._errors[0] if len(self._errors) == 1 else BusFileError(self._errors)
        self.notes.append("sdo, rpdo, tpdo, heartbeats: the master writes them when a node boots")
        lines = [
            f"# The nodes of {self._source.name}, for a master that runs outside the rig.",
            "",
            "[rig]",
            f"name = {json.dumps(self._source.resolve().parent.name)}",
            "seed = 1",
            "",
            "[bus.can0]",
            f"bitrate_bit_s = {baudrate * 1000}",
            *sync,
        ]
        for node in nodes:
            eds = Path(os.path.relpath(node.eds, folder)).as_posix()
            lines += ["", f"[controller.{node.name}]", f'kind = "{node.kind}"', 'bus = "can0"']
            lines += [f"node_id = {node.node_id}", f"eds = {json.dumps(eds)}"]
        return "\n".join(lines) + "\n", self.notes

    def _usable_nodes(self, master_id: int) -> Iterator[_Node]:
        """Yield the nodes that can be emulated, each with a node-ID of its own."""
        taken: dict[int, str] = {master_id: "the master"}
        for name in self._nodes:
            try:
                node = self._node(name, _section(self._source, name, self._nodes[name]))
            except RigError as error:
                self._errors.append(error)
                continue
            if node is None:
                continue
            if node.node_id in taken:
                text = f"node-ID {node.node_id} is also that of {taken[node.node_id]}"
                remedy = "give each a node-ID of its own"
                self._errors.append(self._error(name, "node_id", text, remedy))
            taken.setdefault(node.node_id, name)
            yield node

    def _error(self, name: str, key: str, text: str, remedy: str) -> RigError:
        """Return the error of a key in a section, with its line or that of the section."""
        places = ((name, key), ("defaults", key), (name,))
        line = next((self._lines[place] for place in places if place in self._lines), None)
        return RigError(self._source, text, remedy, line=line, key=name)

    def _sync(self) -> list[str]:
        """Return the declaration of the master's SYNC."""
        period_us = self._whole(self._master, "master", "sync_period", 0)
        if period_us <= 0:
            return []
        length = 1 if self._whole(self._master, "master", "sync_overflow", 0) else 0
        return [
            "",
            "[[bus.can0.message]]            # SYNC of the master",
            "identifier = 0x080",
            f"length = {length}",
            f"period_s = {period_us / 1e6!r}",
        ]

    def _node(self, name: str, own: Mapping[str, object]) -> _Node | None:
        """Return the controller of a node; None with a note if it cannot be emulated."""
        values = {**self._defaults, **own}
        self._tell(name, values, _NODE_USED | _NODE_KNOWN)
        dcf = values.get("dcf")
        if not isinstance(dcf, str):
            text = "no dcf: the file of its objects is missing"
            raise self._error(name, "dcf", text, "write dcf: and its EDS or DCF")
        eds = self._source.parent / dcf.removeprefix(f"{_CONFIG_PATH}/")
        try:
            node_id = self._whole(values, name, "node_id", _commissioned(eds))
            if not 1 <= node_id <= _NODE_ID_MAX:
                text, remedy = f"node_id {node_id} is not 1 to {_NODE_ID_MAX}", "write its node-ID"
                raise self._error(name, "node_id", text, remedy)
            od = read_eds(eds, node_id).dictionary()
        except EdsError as error:
            place = f"{error.path}:{error.line}" if error.line else str(error.path)
            raise self._error(name, "dcf", f"{place}: {error.text}", error.remedy) from None
        if self._whole(values, name, "num_channels", 1) > 1:
            self.notes.append(f"{name}: num_channels: only the first axis moves")
        is_drive = all(od.get(*place) for place in _DRIVE)
        if is_drive or any(od.get(*place) for place in _IO_NODE):
            kind = "cia402" if is_drive else "cia401"
            return _Node(self._controller_name(name), kind, node_id, eds)
        self.notes.append(f"{name}: left out: {dcf} describes neither a drive nor an I/O node")
        return None

    def _controller_name(self, name: str) -> str:
        """Return the name of a node as a rig allows it: a letter, letters, digits, - and _."""
        allowed = _NOT_IN_NAMES.sub("_", name)
        if not allowed[:1].isalpha():
            allowed = f"node_{allowed}"
        if allowed != name:
            self.notes.append(f"{name}: named {allowed} in the rig")
        return allowed

    def _whole(self, section: Mapping[str, object], name: str, key: str, default: int) -> int:
        value = section.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            text = f"{key} is {value!r}; expected a whole number"
            error = self._error(name, key, text, "correct it")
            if name != "master":
                raise error
            self._errors.append(error)
            return default
        return value

    def _tell(self, name: str, section: Mapping[str, object], known: frozenset[str]) -> None:
        unknown = [key for key in section if key not in known]
        if unknown:
            self.notes.append(f"{name}: unknown keys, left out: {', '.join(unknown)}")


def _yaml(source: Path) -> tuple[object, Mapping[tuple[str, ...], int]]:
    """Return the content of a YAML file, and the lines of its sections and their keys."""
    try:
        yaml = import_module("yaml")
    except ModuleNotFoundError:
        remedy = "install it: pip install 'motorhil[yaml]'"
        raise RigError(source, "reading it needs the package PyYAML", remedy) from None
    try:
        text = source.read_bytes()
        content: object = yaml.safe_load(text)
        lines = dict(_lines(yaml.compose(text, yaml.SafeLoader)))
    except OSError as error:
        raise RigError(source, f"cannot be read: {error.strerror}", "check the path") from None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = None if mark is None else mark.line + 1
        what = getattr(error, "problem", None) or "cannot be parsed"
        raise RigError(source, f"is not YAML: {what}", "correct it", line=line) from None
    return content, lines


def _lines(node: Any, *above: str) -> Iterator[tuple[tuple[str, ...], int]]:
    """Yield the lines of sections and of their keys; `nodes` only holds sections.

    The type of a YAML node is that of an optional package.
    """
    for key, value in node.value if getattr(node, "id", "") == "mapping" else ():
        name = str(key.value)
        yield (*above, name), key.start_mark.line + 1
        if not above and name == "nodes":
            for one in value.value if value.id == "sequence" else (value,):
                yield from _lines(one)
        elif not above:
            yield from _lines(value, name)


def _section(source: Path, name: str, value: object) -> Mapping[str, object]:
    """Return a section as a mapping of texts; an empty one has no keys."""
    if value is None:
        return {}
    if not isinstance(value, Mapping):
        remedy = "see ros2_canopen's bus configuration file"
        raise RigError(source, f"{name} is not a section of keys", remedy)
    return {str(key): one for key, one in value.items()}


def _named(source: Path, nodes: object) -> Mapping[str, object]:
    """Return `nodes`: a mapping, or a list of mappings with one name each."""
    if isinstance(nodes, Sequence) and not isinstance(nodes, str):
        named: dict[str, object] = {}
        for one in nodes:
            named.update(_section(source, "nodes", one))
        return named
    return _section(source, "nodes", nodes)


def _commissioned(eds: Path) -> int:
    """Return the node-ID that a DCF is written for; 0 if it names none.

    Raises:
        EdsError: the file cannot be read.
    """
    try:
        sections = EdsText(eds, eds.read_bytes()).sections
    except OSError as error:
        raise EdsError(eds, 0, f"cannot be read: {error.strerror}", "check dcf") from None
    section = sections.get("devicecomissioning")
    field = None if section is None else section.get("nodeid")
    try:
        return 0 if field is None else parse_integer(field.text, 0)[0]
    except ValueError:
        return 0
