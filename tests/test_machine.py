"""What a record says of the machine it was made on."""

from nerfvol.machine import describe_hardware, processor
from nerfvol.native import native


def test_records_say_how_fast_the_processor_ran() -> None:
    hardware = describe_hardware()
    if native() is None:
        assert hardware["clock_ghz"] is None
        assert processor(hardware) == hardware["cpu"]
    else:  # six operations a step that wait for each other: between an old phone and the fastest processor there is, if shared
        assert 0.05 < hardware["clock_ghz"] < 8
        assert processor(hardware) == f"{hardware['cpu']} at {hardware['clock_ghz']:.1f} GHz"


def test_a_record_of_an_earlier_version_has_no_clock() -> None:
    assert processor({"cpu": "a CPU"}) == "a CPU"
