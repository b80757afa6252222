"""Prints the records of a shore site and saves images as PGM: shore_subscriber.py tcp/127.0.0.1:7447 [FOLDER]."""

import pathlib
import signal
import sys

import msgpack
import zenoh

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the program, also while it waits for the router
(folder := pathlib.Path(*sys.argv[2:3])).mkdir(parents=True, exist_ok=True)
# Wait for the router without a time limit.
config = zenoh.Config.from_json5(f'{{mode: "client", connect: {{endpoints: ["{sys.argv[1]}"], timeout_ms: -1}}}}')
print(f"waiting for {sys.argv[1]}", file=sys.stderr)
with zenoh.open(config) as session, session.declare_subscriber("sonarpost/v1/shore/contact/**") as records:
    print("subscribed", file=sys.stderr)
    for sample in records:
        r = msgpack.unpackb(sample.payload.to_bytes())
        if r["type"] != "coded_image":  # the decoded image follows
            print(r["type"], r["vehicle_id"], r["image_id"], r.get("verdict"), r.get("contact"), flush=True)
        if p := r.get("pixels"):
            data = p["data"] if p["bits"] == 8 else bytes(p["data"][n ^ 1] for n in range(len(p["data"])))  # big endian
            head = f"P5 {p['width_px']} {p['height_px']} {2 ** p['bits'] - 1}\n".encode()
            name = f"{r['vehicle_id']}_{r['first_frame_utc_s']:.0f}_{r['image_id']}_v{r['version']}.pgm"
            (folder / name).write_bytes(head + data)
