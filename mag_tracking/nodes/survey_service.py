"""Service `~/survey` of calibration_node: orientations and clock offsets of a running network."""

import datetime
import time
from collections.abc import Sequence
from pathlib import Path

from mag_tracking_msgs.srv import Survey as SurveyMessage

from mag_tracking.calibration.survey import Survey, with_measured_noise
from mag_tracking.errors import OutputError
from mag_tracking.network import SensorNetwork
from mag_tracking.network.file import write_network
from mag_tracking.stages.calibrate.stage import Calibrate

MIN_INTERVAL_S = 0.5
"""[s] Minimum interval between surveys, each of which delays the readings."""


class SurveyService:
    """Solves a survey and saves the resulting network to `save_as` on request.

    `imu_topics` are absolute names, for messages.
    """

    def __init__(self, survey: Survey, stage: Calibrate, save_as: Path,
                 imu_topics: Sequence[str]) -> None:
        self._survey, self._stage, self._save_as = survey, stage, save_as
        self._imu_topics = imu_topics
        self._end_time = -MIN_INTERVAL_S

    def solve(self, network: SensorNetwork, save: bool,
              response: SurveyMessage.Response) -> SensorNetwork | None:
        """Solve a survey, save it on request and fill in the `response`; None if it failed.

        It also fails if a survey has just ended.
        """
        if time.monotonic() - self._end_time < MIN_INTERVAL_S:
            response.message = f'a survey has just been run; try again in {MIN_INTERVAL_S:g} s'
            return None
        try:
            return self._solve_now(network, save, response)
        finally:
            self._end_time = time.monotonic()

    def _solve_now(self, network: SensorNetwork, save: bool,
                   response: SurveyMessage.Response) -> SensorNetwork | None:
        """Solve a survey without checking the interval; see `solve`."""
        # If a target is near a sensor, the background was measured before its arrival.
        fields = {name: self._stage.background(name)
                  for name, background in self._stage.backgrounds().items()
                  if background.certain and self._stage.last_stamp_ns(name) is not None}
        if not fields or not self._survey.counts['accelerations']:
            response.message = 'no background has been learnt yet; keep targets away for a while' \
                if not fields else 'no acceleration received on ' \
                f'{", ".join(filter(None, self._imu_topics))}'
            return None
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec='seconds')
        solution = self._survey.solve(fields, date)
        surveyed = with_measured_noise(solution.network, self._stage.backgrounds())
        if save:
            try:
                write_network(self._save_as, surveyed, 'Written by calibration_node.')
            except OutputError as error:
                response.message = str(error)
                return None
        response.success = True
        response.message = (
            'the result is in use'
            + (f' and saved to {self._save_as}; use that file at the next start' if save else '')
            + f'; clock reference: {solution.reference or "none, because no knock was detected"}')
        response.warnings = solution.warnings()
        response.warnings += [f'{name}: no background has been learnt; its heading remains as '
                              'in the network file'
                              for name in surveyed.names if name not in fields]
        return surveyed
