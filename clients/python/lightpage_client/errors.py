"""Every error that the service may raise."""
# ruff: noqa: F403

from lightpage_client.lightpage.errors import *
from lightpage_client.runtime.errors import *
