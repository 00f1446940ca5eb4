"""Notice of a long wait."""

import time

from scenes.play.waiting_notice import MIN_REPORTED_TIME, WaitingNotice


def test_long_wait_is_reported_and_short_wait_is_not():
    said: list[str] = []
    busy = WaitingNotice(said.append)
    busy.begin_work("a quick load")
    busy.end_work()
    time.sleep(MIN_REPORTED_TIME + 0.3)
    assert said == []
    busy.begin_work("solving the first half")
    busy.begin_work("solving the second half")
    time.sleep(MIN_REPORTED_TIME + 0.3)
    busy.end_work()
    busy.close()
    assert said[0].startswith("solving the second half") and said[-1] == "" and "" not in said[:-1]
