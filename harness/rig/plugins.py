"""Plugins that build the controllers and motors of one rig."""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, final

from motorhil.harness.plugins import ADAPTATIONS, Plugin, PluginVersionError, named
from motorhil.harness.rig.config.buses import CAN, address_key
from motorhil.harness.rig.config.rig_file import RigDescription
from motorhil.harness.rig.config.toml import BrokenPluginError, RigError, a_kind_of
from motorhil.motorapi.errors import UsageError
from motorhil.settings import SettingError

if TYPE_CHECKING:
    from motorhil.emulators.controller import Controller
    from motorhil.motorapi.model import MotorModel
    from motorhil.motorapi.motor import Motor
    from motorhil.motorapi.runtime.api import Runtime

_OF_MOTORS: Final = ("close", "latest", "ownership")
"""Attributes by which a rig recognises a motor; wrappers of motors have them too."""


@final
class RigPlugins:
    """The plugins that build the controllers and motors of one rig."""

    def __init__(self, description: RigDescription) -> None:
        self._description: Final = description

    def load(self, plugin: Plugin, path: tuple[str, ...]) -> Callable[..., Any]:
        """Return the build function of the plugin that the value at `path` names.

        Raises:
            BrokenPluginError: the plugin cannot be imported.
        """
        try:
            return plugin.load()
        except PluginVersionError as error:
            problem = f'plugin "{plugin.name}" ({plugin.target}) {error.problem}'
            raise self._description.error(path, problem, error.remedy, BrokenPluginError) from error
        except (Exception, SystemExit) as error:
            raise self._description.error(
                path,
                f'plugin "{plugin.name}" cannot be loaded from {plugin.target}: '
                f"{type(error).__name__}: {error}",
                f"reinstall {plugin.package}" if plugin.package else "is its folder on PYTHONPATH?",
                BrokenPluginError,
            ) from error

    def require_kind(
        self, build: Callable[..., Any], bus: str, what: str, path: tuple[str, ...]
    ) -> None:
        """Check that the built object can be on a bus of this kind.

        Raises:
            RigError: it cannot.
        """
        kinds = getattr(build, "bus_kinds", (CAN,))
        found = self._description.buses[bus].kind
        if found not in kinds:
            raise self._description.error(
                path,
                f'{what} is for buses of kind {", ".join(kinds)}, but "{bus}" is {found}',
                "put it on another bus, or use another kind",
            )

    @contextmanager
    def blaming(self, plugin: Plugin, path: tuple[str, ...]) -> Iterator[None]:
        """Raise any error within the context, except RigError, as the plugin's failure."""
        try:
            yield
        except RigError:
            raise
        except (Exception, SystemExit) as error:
            frame = traceback.extract_tb(error.__traceback__)[-1]
            raise self._description.error(
                path,
                f'plugin "{plugin.name}" failed: {type(error).__name__}: {error} '
                f"({frame.filename}:{frame.lineno})",
                f"fix it, or report it to the author of {plugin.package or 'the plugin'}",
                BrokenPluginError,
            ) from error

    def motor(
        self,
        name: str,
        model: "MotorModel",
        runtime: "Runtime",
        open_link: Callable[[str], object],
        controller: "Controller | None" = None,
    ) -> "tuple[Motor, Callable[[], None], str]":
        """Return a motor of the rig, the function that closes it, and a note about it, or "".

        Args:
            name: its name in the rig.
            model: its model.
            runtime: the Runtime in which it waits.
            open_link: returns the bus or line of a name.
            controller: its emulated controller, if that is in the same process.

        Raises:
            RigError: the motor cannot be built as the rig describes it.
        """
        from motorhil.harness.rig.config.derived import with_timing  # it needs the emulated drives

        description = self._description
        motor = description.motors[name]
        place = ("motor", name)
        plugin = named(ADAPTATIONS, motor.adaptation)
        build = self.load(plugin, (*place, "adaptation"))
        own, note = with_timing(description, motor, controller)
        settings: dict[str, object] = {"name": name, **own}
        link: object = None
        if motor.bus is not None:
            key = "bus" if motor.controller is None else "controller"
            what = f'adaptation "{motor.adaptation}"'
            self.require_kind(build, motor.bus, what, (*place, key))
            link = open_link(motor.bus)
            if motor.node_id is not None:
                settings[address_key(description.buses[motor.bus])] = motor.node_id
        with self.blaming(plugin, (*place, "adaptation")):
            try:
                built: Motor = build(link, settings, model, runtime)
            except UsageError as error:
                cause = error.__cause__
                if isinstance(cause, SettingError):
                    wrong = cause.below(place)
                    raise description.error(wrong.path, wrong.message, wrong.remedy) from error
                word = str(error).partition(" ")[0].rstrip(":")  # usually the wrong key
                path = (*place, word) if word in settings else place
                raise description.error(path, str(error), "correct its settings") from error
        if isinstance(built, type) or not all(hasattr(built, one) for one in _OF_MOTORS):
            raise description.error(
                (*place, "adaptation"),
                f'plugin "{plugin.name}" built {a_kind_of(built)}, which is not a motorapi.Motor',
                "its function must return a motorapi.Motor",
                BrokenPluginError,
            )
        return built, built.close, note
