"""Two slides on a serial line make steps in turn; a step is made once, or has failed."""

from contextlib import suppress

from motorhil.harness.swarm.properties import always, sometimes
from motorhil.motorapi import ControlMode, DeadlineExceeded, MotorError
from tests.conformance.mutants import MUTANTS, failures  # noqa: F401 -- it registers mutants
from tests.system.swarm.defects import correct, defect
from tests.system.swarm.defects.truth import Truth

RIG = "line.toml"
STEPS = (0.3, 0.5)
NEAR_RAD = 0.03
COASTING_RAD = 0.4  # a slide without current goes on less far; the second step is longer


class Line:
    """Each step is a distance; a step that failed is made up for by its target, once."""

    def __init__(self, rig):
        self.rig, self.runtime = rig, rig.runtime
        self.truth = Truth(rig)
        self.slides = [rig.motors["left"], rig.motors["right"]]

    def run(self):
        """Make all steps, or give up; then no slide has made a step twice."""
        places = {}
        try:
            for slide in self.slides:
                slide.enable()
                slide.set_control_mode(ControlMode.SETPOINT)
            for slide in self.slides:
                places[slide] = slide.position()
            for step in STEPS:
                for slide in self.slides:
                    places[slide] += step
                    self.step(slide, places[slide], step)
                    self.look(slide)
        except MotorError:
            sometimes(True, "the line gives up")
            self.rest()
        self.runtime.run_for(0.5)
        for slide, place in places.items():
            beyond = self.truth.position(slide.name) - place
            always(beyond < COASTING_RAD, "a slide is where its steps lead, or short of it")

    def step(self, slide, place, distance):
        """Make a step; if it failed, go to the place where it should have ended."""
        try:
            slide.set_setpoint(distance, relative=True)
            slide.start()
            slide.wait_until_done(timeout_s=2.0)
        except DeadlineExceeded:
            sometimes(True, "a step is made up for")
            slide.stop()
            slide.wait_until_done(timeout_s=1.0)
            slide.set_setpoint(place)
            slide.start()
            slide.wait_until_done(timeout_s=2.0)
        off = abs(self.truth.position(slide.name) - place)
        always(off < NEAR_RAD, "a slide is where its steps lead")

    def look(self, slide):
        """Read a slide that stands."""
        off = abs(slide.position() - self.truth.position(slide.name))
        always(off < NEAR_RAD, "a position that was read is the true one")
        always(abs(slide.velocity()) < 0.2, "a slide that was awaited stands")

    def rest(self):
        """Stop both slides, as far as they hear."""
        for slide in self.slides:
            with suppress(MotorError):
                slide.stop()


line = correct(RIG)(Line)


# --- defects -------------------------------------------------------------------------------------


def _mutant(name):
    return lambda: MUTANTS[name].plant()


@defect(RIG, "always | a", patches=_mutant("the_next_answer_is_the_answer"))
class TakesALateAnswer(Line):
    """In the adaptation: the next request is sent right after a timeout, and a late answer of the
    right length is taken for its own."""


@defect(RIG, "always | a slide is where", patches=_mutant("a_lost_start_is_made_again"))
class MovesTwice(Line):
    """In the adaptation: a start without an answer is made again, from where the motor is then."""
