"""Cameras without middleware: each comes by a source of its own and joins the observations of any transport."""

# Each kind with its module, which is imported where a deployment names it.
KINDS = {
    "file": "runtime.cameras.file",
    "mjpeg": "runtime.cameras.mjpeg",
    "rtsp": "runtime.cameras.rtsp",
    "v4l2": "runtime.cameras.v4l2",
}
