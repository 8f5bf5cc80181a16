"""schemathesis over the OpenAPI document, with a real mission behind it: every answer is one that it tells of."""

from __future__ import annotations

from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis import Case

from services.status.app import SharedStatus, create_app
from services.status.config import Config
from services.status.security import Access, Role, Token, _digest
from tests.status.mission_behind import MissionBehind
from tests.status.test_api import SECRET
from tests.status.test_app import Clock, fill

_HEADERS = {"Authorization": f"Bearer {SECRET}", "Host": "127.0.0.1:8080"}


def _application() -> object:
    shared = SharedStatus(Config(), "husky1", Clock())
    fill(shared)
    MissionBehind(shared)
    app = create_app(shared)
    app.state.access = Access((Token(Role.operator, "test", _digest(SECRET)),))
    return app


schema = schemathesis.openapi.from_asgi("/openapi.json", _application(), headers=_HEADERS).exclude(
    path="/api/v1/events/stream"  # it does not end; its finite form is tested in test_api
)


@pytest.mark.slow
@schema.parametrize()
@settings(
    max_examples=15,
    deadline=None,
    derandomize=True,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
def test_every_answer_is_in_the_document(case: Case[Any]) -> None:
    # Whether a ring is closed and does not cross itself is more than a JSON schema can say: 422 is right for it.
    checks = [schemathesis.checks.positive_data_acceptance]
    case.call_and_validate(headers=_HEADERS, excluded_checks=checks)
