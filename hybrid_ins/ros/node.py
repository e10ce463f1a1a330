"""
``ins_node``: the estimator as a lifecycle node of ROS 2.

    unconfigured -> inactive      configure: parameters, noise model, compiled filter, publishers
    inactive     -> active        activate: subscriptions, services, timers
    active       -> inactive      deactivate: they end, the state is kept
    inactive     -> unconfigured  clean up: the state is discarded

With the parameter ``autostart`` the node configures and activates itself. The transitions, and what
a failing one leads to, are those of [1]_, as nav2_lifecycle_manager expects.

References
----------
.. [1] G. Biggs, T. Foote, "Managed nodes", design.ros2.org/articles/node_lifecycle.html.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

try:
    import rclpy
except ModuleNotFoundError as error:
    if error.name != "rclpy":
        raise
    raise SystemExit(
        "ins_node: error: ROS 2 is not installed: source /opt/ros/jazzy/setup.bash, or install its "
        'wheels: pip install "hybrid_ins[ros]"'
    ) from None
from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError, RCLInvalidROSArgsError, UnknownROSArgsError
from rclpy.exceptions import ParameterException, ParameterNotDeclaredException
from rclpy.executors import ExternalShutdownException
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from hybrid_ins import kernels, parameters, signals
from hybrid_ins.errors import InputError
from hybrid_ins.noise_regressor.reader import find_regressor
from hybrid_ins.ros import node_arguments, node_parameters
from hybrid_ins.ros.callback_guard import CallbackGuard
from hybrid_ins.ros.live_estimator import LiveEstimator
from hybrid_ins.ros.messages.node_messages import new_message
from hybrid_ins.ros.reporting.input_log import InputLog
from hybrid_ins.ros.start.memory import release_memory_of_start
from hybrid_ins.ros.start.warm_up import warm_up


class InsNode(LifecycleNode):
    """INS/GNSS navigation of one vehicle."""

    def __init__(self) -> None:
        super().__init__(parameters.NODE_NAME)
        self._live: LiveEstimator | None = None
        self._errors = CallbackGuard(InputLog(self._log))
        try:
            self.autostart = bool(self._declare(parameters.PARAMETERS["autostart"], True))
            for p in parameters.PARAMETERS.values():
                if p.name != "autostart":
                    self._declare(p, self.autostart)
        except ParameterException:
            self._check_overrides()  # names all that are wrong, and not the first alone
            raise
        self._warn_of_unknown_parameters()
        self.add_pre_set_parameters_callback(node_parameters.read_texts)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._use_parameters)
        self._answer_impossible_transitions()

    def _declare(self, parameter: Any, fixed: bool) -> Any:
        described = node_parameters.descriptor(parameter, fixed)
        return self.declare_parameter(parameter.name, parameter.default, described).value

    # Transitions.

    def start(self) -> None:
        """
        Configure and activate.

        Raises
        ------
        InputError
            A parameter has an impossible value.
        """
        self._values()
        for trigger in (self.trigger_configure, self.trigger_activate):
            if trigger() != TransitionCallbackReturn.SUCCESS:
                raise InputError("the node could not be started: see the log")

    def stop(self) -> None:
        """Shut down in order, from any state."""
        if self._live is not None:
            try:
                self.trigger_shutdown()
            except RCLError:  # ended within a transition
                self._discard()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Check the parameters, load the noise model and the filter, and publish."""
        return self._transition("configure", self._configure, self._discard)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe, and offer the services."""
        return self._transition("activate", self._activate, self._deactivate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop to listen."""
        return self._transition("deactivate", self._deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard the state and the publishers."""
        return self._transition("clean up", self._discard)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish what is left and a last diagnostics message."""
        return self._transition("shut down", self._discard)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Discard everything, so that the node can be configured again."""
        return self._transition("process an error", self._discard)

    def _transition(
        self, name: str, action: Callable[[], None], undo: Callable[[], None] = lambda: None
    ) -> TransitionCallbackReturn:
        """Do what a transition asks for; it fails with one line in the log, and is undone."""
        try:
            action()
        except InputError as error:
            self.get_logger().error(f"{name}: {error}")
            undo()
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would discard it
            self.on_exception(error)
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        values = self._values()
        if not self.autostart and values["noise.mode"] == "learned":
            # Without a manager nobody could correct it: the node then uses the fallback.
            find_regressor(str(values["noise.model"]))
        kernels.prepare(self.get_logger().info)
        warm_up(new_message, values)
        self._live = LiveEstimator(self, values, self._log)
        self._live.advertise()
        release_memory_of_start()

    def _activate(self) -> None:
        assert self._live is not None
        self._live.activate()
        waiting_for = self._live.estimator.status.waiting_for
        self.get_logger().info("ready" + (f": waiting for {waiting_for}" if waiting_for else ""))

    def _deactivate(self, state: str = "inactive") -> None:
        if self._live is not None and self.context.ok():
            self._live.deactivate(state)

    def _discard(self) -> None:
        self._deactivate("shut down")
        live, self._live = self._live, None
        if live is not None:
            live.destroy()

    def _answer_impossible_transitions(self) -> None:
        """Answer requests that the present state does not allow; rclpy lets the client wait."""
        service = self._service_change_state
        change_state = service.callback

        def answer(request: Any, response: Any) -> Any:
            try:
                return change_state(request, response)
            except RCLError:
                transition = request.transition.label or request.transition.id
                self.get_logger().warning(f"transition {transition}: not in the present state")
                response.success = False
                return response

        service.callback = answer

    def on_exception(self, error: Exception) -> None:
        """Count and log what no callback should raise."""
        (self._errors if self._live is None else self._live.guard).on_error(error)

    def _log(self, level: str, text: str) -> None:
        # One line for each level: rclpy ties a severity to the line it is logged from.
        if level == "info":
            self.get_logger().info(text)
        elif level == "warn":
            self.get_logger().warning(text)
        else:
            self.get_logger().error(text)

    # Parameters.

    def set_parameters_atomically(self, parameter_list: list[Any]) -> SetParametersResult:
        """Set parameters together; a name that is none is refused with the one that is meant."""
        try:
            return super().set_parameters_atomically(parameter_list)
        except ParameterNotDeclaredException as error:
            return SetParametersResult(
                successful=False, reason=node_parameters.unknown(parameter_list) or str(error)
            )

    def _values(self) -> dict[str, Any]:
        """Return all parameters, checked."""
        given = {name: self.get_parameter(name).value for name in parameters.PARAMETERS}
        return dict(
            parameters.check_all(
                {name: node_parameters.plain(value) for name, value in given.items()}
            )
        )

    def _check_overrides(self) -> None:
        given = {name: override.value for name, override in self._parameter_overrides.items()}
        known = given.keys() & parameters.PARAMETERS.keys()
        parameters.check_all({name: node_parameters.plain(given[name]) for name in sorted(known)})

    def _warn_of_unknown_parameters(self) -> None:
        """Warn of names that ROS ignores silently; a file for '/**' may address other nodes."""
        for name in self._parameter_overrides:
            if name != "use_sim_time" and not name.startswith("qos_overrides."):
                try:
                    parameters.find(name)
                except InputError as error:
                    self.get_logger().warning(str(error))

    def _check_parameters(self, changes: list[Any]) -> SetParametersResult:
        try:
            self._check_model(self._checked(changes))
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _check_model(self, checked: dict[str, Any]) -> None:
        """Refuse another model that cannot be used; the one in force goes on."""
        if self._live is None or "noise.model" not in checked:
            return
        if checked["noise.model"] != self._live.estimator.values["noise.model"]:
            find_regressor(str(checked["noise.model"]))

    def _checked(self, changes: list[Any]) -> dict[str, Any]:
        """Check changes of this package's parameters; others are not ours to check."""
        ours = [p for p in changes if p.name in parameters.PARAMETERS]
        known = {p.name: node_parameters.plain(p.value) for p in ours}
        if self._live is None:  # they take effect together when the node is configured
            return {name: parameters.find(name).check(value) for name, value in known.items()}
        return parameters.check_change(self._live.estimator.values, known)

    def _use_parameters(self, changes: list[Any]) -> None:
        try:
            checked = self._checked(changes)
            if checked and self._live is not None:
                self._live.change(checked)
        except Exception as error:  # see `CallbackGuard`
            self.on_exception(error)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node until Ctrl-C, SIGTERM, or SIGHUP unless that is ignored (``nohup``)."""
    arguments = list(sys.argv if argv is None else ["ins_node", *argv])
    if {"-h", "--help"} & set(arguments[1:]):
        print(node_parameters.help_text())
        return 0
    try:
        with node_arguments.for_ros(arguments[1:]) as words:
            rclpy.init(args=[arguments[0], *words], signal_handler_options=SignalHandlerOptions.NO)
    except (InputError, RCLError, RCLInvalidROSArgsError, UnknownROSArgsError) as error:
        return _refuse_start(error)
    asked_to_stop: Future[None] = Future()
    starting = True

    def stop(*_: object) -> None:
        asked_to_stop.set_result(None)
        if starting:  # nothing else ends a compilation of a minute
            raise KeyboardInterrupt

    for number in signals.that_end():
        signal.signal(number, stop)
    node = None
    try:
        node = InsNode()
        if not node.autostart and not kernels.is_compiled():
            # A lifecycle manager waits for a node to appear, but not a minute for a transition.
            node.destroy_node()
            kernels.prepare(rclpy.logging.get_logger(parameters.NODE_NAME).info)
            node = InsNode()
        for text in node_arguments.unused_files(arguments[1:], node.get_fully_qualified_name()):
            node.get_logger().warning(text)
        if node.autostart:
            node.start()
        else:
            node.get_logger().info("unconfigured: waiting for a lifecycle manager")
        starting = False
        executor = EventsExecutor()
        executor.add_node(node)
        while rclpy.ok() and not asked_to_stop.done():
            try:
                # The executor's endless spin() ignores signals.
                executor.spin_until_future_complete(asked_to_stop, 0.2)
            except ExternalShutdownException:
                break
            except Exception as error:  # what no callback caught
                node.on_exception(error)
                time.sleep(0.01)  # it may come again at once
    except (ExternalShutdownException, KeyboardInterrupt):
        pass
    except (InputError, ParameterException, RCLError) as error:
        return _refuse_start(error)
    finally:
        starting = False
        if node is not None:
            node.stop()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _refuse_start(error: Exception) -> int:
    """Print in one line why the node does not start."""
    line = str(error) if isinstance(error, InputError) else node_arguments.reason_of(error)
    if isinstance(error, UnknownROSArgsError):
        line = f"unknown ROS arguments {line}: see ins_node --help"
    print(f"ins_node: error: {line}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    exit_status = main()
    sys.stdout.flush()
    os._exit(exit_status)
