"""The service `~/survey` of calibration_node: orientations and clocks of a running network."""

import datetime
import time
from collections.abc import Sequence
from pathlib import Path

from mag_tracking_msgs.srv import Survey as SurveyMessage

from mag_tracking.errors import OutputError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.stages.calibrate.stage import Calibrate
from mag_tracking.stages.survey.stage import Survey, with_measured_noise

PAUSE_S = 0.5
"""[s] Calls that come sooner after the last one are refused: readings wait while it is solved."""


class SurveyService:
    """Solves a survey and saves the network that it found."""

    def __init__(self, survey: Survey, stage: Calibrate, save_as: Path,
                 imu_topics: Sequence[str]) -> None:
        self._survey, self._stage, self._save_as = survey, stage, save_as
        self._imu_topics = imu_topics
        self._ended = -PAUSE_S

    def solve(self, network: SensorNetwork, save: bool,
              response: SurveyMessage.Response) -> SensorNetwork | None:
        """The network as it was found, or None; the response says what came of it."""
        if time.monotonic() - self._ended < PAUSE_S:
            response.message = f'a survey has just run: try again in {PAUSE_S:g} s'
            return None
        try:
            return self._solve(network, save, response)
        finally:
            self._ended = time.monotonic()

    def _solve(self, network: SensorNetwork, save: bool,
               response: SurveyMessage.Response) -> SensorNetwork | None:
        """As `solve`, now."""
        # Of a sensor with a target nearby, the background from before it came.
        fields = {name: self._stage.background(name)
                  for name, background in self._stage.backgrounds().items()
                  if background.certain and self._stage.last_stamp_ns(name) is not None}
        if not fields or not self._survey.counts['accelerations']:
            response.message = 'no background has been learnt yet' if not fields else \
                f'no acceleration has come on {", ".join(filter(None, self._imu_topics))}'
            return None
        date = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds')
        found = self._survey.solve(fields, date)
        surveyed = with_measured_noise(found.network, self._stage)
        if save:
            try:
                write_network(self._save_as, surveyed, 'Written by calibration_node.')
            except OutputError as error:
                response.message = str(error)
                return None
        response.success = True
        response.message = (
            'in force'
            + (f', and saved in {self._save_as}, to be given at the next start' if save else '')
            + f'; clocks against {found.reference or "none: no knock was felt"}')
        response.warnings = found.warnings()
        response.warnings += [f'{name}: no background has been learnt: its heading stays as stated'
                              for name in surveyed.names if name not in fields]
        return surveyed
