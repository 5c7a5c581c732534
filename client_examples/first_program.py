"""A first program: press the model's first tool 3 mm into the tissue, and print the force that pushes it back.

Start `palpate serve liver.npz` in another terminal. Needs eclipse-zenoh and msgpack.
"""

from palpate_client import Connection, Tool, steps

with Connection("tcp/127.0.0.1:7447") as connection, Tool(connection) as tool:
    for i in steps(duration_s=2.0, period_s=0.001):
        depth_m = 0.003 * min(1.0, i / 1000)
        tool.move(tool.at_depth(depth_m))
        x, y, z = tool.take_force()
        if i % 200 == 0:
            print(f"{1e3 * depth_m:.1f} mm deep: {x:+.3f} {y:+.3f} {z:+.3f} N")
