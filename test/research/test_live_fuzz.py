"""The live fuzzer's messages are messages; `python -m tools.robustness.live_fuzz` sends them."""

import numpy as np
import pytest

from hybrid_ins.bags.messages import TYPES
from tools.robustness.live_fuzz import INPUTS, random_bytes, random_message


@pytest.mark.parametrize("type_name", sorted(set(INPUTS.values())))
def test_random_messages_are_well_formed_and_random_bytes_are_not(type_name: str) -> None:
    rng = np.random.default_rng(0)
    texts = set()
    for _ in range(20):
        message = TYPES.deserialize_cdr(random_message(rng, type_name), type_name)
        texts.add(message.header.frame_id)
    assert len(texts) > 5

    damaged = 0
    for _ in range(40):
        try:
            TYPES.deserialize_cdr(random_bytes(rng, type_name), type_name)
        except Exception:  # whatever noise provokes
            damaged += 1
    assert damaged > 10
