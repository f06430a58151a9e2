"""Authenticated access for browsers: address and secrets, TLS and message schemas."""

from hrc_learn.teleoperation.gate.address import Address as Address
from hrc_learn.teleoperation.gate.address import AddressConfig as AddressConfig
from hrc_learn.teleoperation.gate.address import qr_code as qr_code
from hrc_learn.teleoperation.gate.gate import Content as Content
from hrc_learn.teleoperation.gate.gate import Gate as Gate
from hrc_learn.teleoperation.gate.gate import folder_contents as folder_contents
