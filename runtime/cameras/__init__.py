"""Cameras that the deployment opens itself, one module per kind; their pictures are added to the observations of any
transport.
"""

# Module of each kind. It is imported only if a deployment names it.
KINDS = {
    "file": "runtime.cameras.file",
    "lerobot": "runtime.cameras.lerobot",
    "mjpeg": "runtime.cameras.mjpeg",
    "rtsp": "runtime.cameras.rtsp",
    "v4l2": "runtime.cameras.v4l2",
}
