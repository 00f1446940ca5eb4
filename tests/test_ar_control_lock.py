"""Control of a page by one visitor at a time."""

from ar.page.control_lock import MAX_IDLE_TIME, ControlLock


class TestLead:
    def test_control_passes_to_first_request_then_oldest_visitor(self):
        lead = ControlLock()
        lead.update_clients({2, 3, 4}, 0.0)
        assert lead.holder == 2 and lead.record_change(2, 1.0) and not lead.record_change(3, 1.0)
        for visitor in (4, 3):
            lead.request_control(visitor, 2.0)
        assert (
            lead.holder == 2
            and "Visitor 4 requests" in lead.describe_control(2, {2, 3, 4})
            and "requested" in lead.describe_control(3, {2, 3, 4})
        )
        lead.update_clients({3, 4}, 3.0)
        assert lead.holder == 4 and lead.queue == (3,)
        lead.give_control(4.0)
        assert lead.holder == 3
        lead.update_clients({4, 5}, 5.0)
        assert lead.holder == 4 and not lead.describe_control(4, {4})

    def test_idle_leader_loses_control_on_request(self):
        lead = ControlLock()
        lead.update_clients({1, 2}, 0.0)
        lead.record_change(1, 10.0)
        lead.request_control(2, 10.0 + MAX_IDLE_TIME)
        assert lead.holder == 2 and lead.queue == ()
