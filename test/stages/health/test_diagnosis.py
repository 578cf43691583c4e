"""Ranking of findings: a cause precedes the consequences that it explains."""

import itertools

import pytest

from mag_tracking.stages.health.diagnosis import Cause, Finding, ranked


def finding(cause, subject='mag_1', serious=False):
    return Finding(serious, subject, f'{cause.value} of {subject}', 'repair it', cause)


def causes(diagnoses):
    return [(d.finding.cause, [f.cause for f in d.consequences]) for d in diagnoses]


def test_a_consequence_follows_its_cause_and_makes_it_serious():
    found = [finding(Cause.NO_BACKGROUND, serious=True), finding(Cause.NOISY, 'mag_2'),
             finding(Cause.WRONG_UNIT)]
    diagnoses = ranked(found)
    assert causes(diagnoses) == [(Cause.WRONG_UNIT, [Cause.NO_BACKGROUND]), (Cause.NOISY, [])]
    assert [d.serious for d in diagnoses] == [True, False]


def test_a_cause_of_another_sensor_explains_nothing():
    found = [finding(Cause.WRONG_UNIT, 'mag_2'), finding(Cause.NO_BACKGROUND)]
    assert all(not d.consequences for d in ranked(found))


def test_a_chain_of_consequences_follows_the_first_cause():
    found = [finding(Cause.NO_DETECTION, 'detect'), finding(Cause.NO_BACKGROUND),
             finding(Cause.NO_MESSAGES)]
    assert causes(ranked(found)) == [
        (Cause.NO_MESSAGES, [Cause.NO_DETECTION, Cause.NO_BACKGROUND])]


def test_repetitions_explain_doubtful_backgrounds_only_if_they_make_a_sensor_too_slow():
    doubtful, repeated = finding(Cause.DOUBTFUL_BACKGROUND), finding(Cause.REPEATED)
    assert len(ranked([doubtful, repeated])) == 2
    assert causes(ranked([doubtful, repeated, finding(Cause.RATE_TOO_LOW)])) == [
        (Cause.REPEATED, [Cause.DOUBTFUL_BACKGROUND, Cause.RATE_TOO_LOW])]


def test_an_overloaded_computer_explains_the_times_of_all_sensors():
    found = [finding(Cause.CLOCK_STEPPED, serious=True), finding(Cause.LOST, 'mag_2'),
             finding(Cause.DELAY_VARIES), finding(Cause.OVERLOADED, 'computer')]
    (diagnosis,) = ranked(found)
    assert causes([diagnosis]) == [(Cause.OVERLOADED, [Cause.LOST, Cause.DELAY_VARIES])]
    assert 'stepped' not in str(diagnosis) and not diagnosis.serious


def test_findings_of_one_cause_are_one_diagnosis():
    found = [finding(Cause.SPIKES), Finding(True, 'mag_1', '3 rejected', '', Cause.SPIKES)]
    (diagnosis,) = ranked(found)
    assert diagnosis.finding is found[0] and diagnosis.consequences == (found[1],)


def test_no_cause_explains_itself():
    """Every set of findings has a cause that is not a consequence."""
    for pair in itertools.permutations(Cause, 2):
        assert ranked(map(finding, pair)), pair
    assert ranked(map(finding, Cause))


@pytest.mark.parametrize('cause', Cause)
def test_a_single_finding_is_a_diagnosis(cause):
    assert causes(ranked([finding(cause)])) == [(cause, [])]
