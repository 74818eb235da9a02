"""C for on-device refinement of the last layer; see `dmrl.deploy.int8.refinement`."""

import numpy as np

from dmrl.deploy.c.buffer_plan import plan_buffers
from dmrl.deploy.c.templating import fill_template, wrap_words
from dmrl.deploy.int8.network import IntegerNetwork
from dmrl.deploy.int8.refinement import compute_gains, find_last_layer


def generate_refinement(network: IntegerNetwork, names: dict[str, str]) -> dict[str, str]:
    """Generate the files of the refinement: name to text.

    Raises
    ------
    ModelError
        If the last layer cannot be refined.
    """
    layer, planned = find_last_layer(network), plan_buffers(network, features=True)
    features, grid = planned.buffers[planned.steps[-1].sources[0]], planned.buffers[-1]
    rows = [head.channel for head in network.heads.values()]
    weights = [f"{w}," for w in layer.weight[rows].ravel().tolist()]
    numbers = np.column_stack([layer.bias[rows], layer.multiplier[rows], *compute_gains(network)])
    offsets = "h == {}_OFFSET_U ? u_q4 % step : v_q4 % step".format(names["PREFIX"])
    size = {"features": features.channels}
    return {
        f"{names['prefix']}_refine.h": fill_template("refine.h", **names, **size),
        f"{names['prefix']}_refine.c": fill_template(
            "refine.c",
            **names,
            weights="\n".join(wrap_words(weights, "    ")),
            heads="".join(f"    {{{', '.join(map(str, each))}}},\n" for each in numbers.tolist()),
            member=features.home,
            row_bytes=features.row_bytes,
            start=features.gap * features.channels,
            set="".join(
                f"    case {names['PREFIX']}_{name.upper()}: net->{grid.home}"
                f"[row * {grid.row_bytes} + col * {grid.channels} + {head.channel}] = "
                "(uint8_t)value; break;\n"
                for name, head in network.heads.items()
            ),
            shift=layer.shift,
            place=f"({offsets})" if network.offset_u is not None else "0",
        ),
    }
