"""Selection of the source of a device's only sensor."""

from mag_tracking.drivers.single_source import RELEASE_TIMEOUT_S, SingleSource

DEVICE, STRAY = ('', '10.0.0.5'), ('', '10.0.0.66')
S = 1_000_000_000


def test_a_stray_first_message_blocks_the_device_only_until_the_timeout():
    source = SingleSource()
    assert source.accepts(STRAY, 0)
    times = [round((0.1 + 0.1 * k) * S) for k in range(100)]
    accepted = [source.accepts(DEVICE, t) for t in times]
    first = accepted.index(True)
    assert (all(accepted[first:]) and times[first] / S <= RELEASE_TIMEOUT_S + 0.2
            and source.changes == 1)
    # A stray message while the device sends is refused.
    assert not source.accepts(STRAY, times[-1] + 1) and source.accepts(DEVICE, times[-1] + 2)


def test_a_slow_source_is_kept_while_no_other_sends():
    source = SingleSource()
    assert all(source.accepts(DEVICE, k * 60 * S) for k in range(5)) and source.changes == 0
