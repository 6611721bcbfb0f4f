from twofold.viewer.browser import QUICK, SLOW, Pace


def noted(pace: Pace, seconds: float, times: int) -> bool:
    for _ in range(times):
        pace.note(seconds)
    return pace.slow


def test_browser_is_slow_only_after_several_slow_images_and_stays_so_until_it_is_quick() -> None:
    pace = Pace()
    assert not noted(pace, 2 * SLOW, 2)  # a hiccup
    assert noted(pace, 2 * SLOW, 20)
    between = 0.5 * (SLOW + QUICK)
    assert noted(pace, between, 50)  # smaller images arrive sooner: no reason to go back
    assert not noted(pace, 0.5 * QUICK, 20)
    assert not noted(pace, between, 50)
