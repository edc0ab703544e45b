"""What a check found, in one line."""

from mdf_core.check_result import Check, describe_failures


def test_what_failed_is_told_in_one_line():
    found = [
        Check("watertight", True, "every edge joins exactly two faces", None),
        Check("self_intersections", False, "12 new pairs of faces cut each other", (12.08, 3.0, 44.84)),
        Check("stretch", False, "edges change their length by up to 30 %", (1.0, 2.0, -3.0)),
    ]
    assert describe_failures(found) == (
        "self_intersections: 12 new pairs of faces cut each other, near (12.1, 3.0, 44.8) mm; "
        "stretch: edges change their length by up to 30 %, near (1.0, 2.0, -3.0) mm"
    )
    assert describe_failures(found[:1]) == ""
