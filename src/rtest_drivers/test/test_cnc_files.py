"""Device files of the CNC driver: what they give, and what is refused in one line."""

import math
from pathlib import Path

import pytest

from rtest_drivers.cnc.linuxcnc import load_linuxcnc
from rtest_drivers.cnc.mtconnect import load_mtconnect
from rtest_drivers.cnc.opcua import load_opcua
from rtest_estimation.errors import UserError

LINUXCNC = """
host: 10.0.0.5
rate_hz: 250
axes:
  X: {index: 0, unit: mm}
  Y: {index: 1, unit: inch, sign: -1}
  B: {index: 3, unit: deg, sign: -1}
"""
OPCUA = """
url: opc.tcp://10.0.0.6:4840
axes:
  X: {node: 'ns=2;s=/Channel/MachineAxis/measPos1[u1,1]', unit: mm}
"""
MTCONNECT = """
url: http://10.0.0.7:5000
axes:
  X: {item: Xact, unit: mm}
"""
LOADERS = {LINUXCNC: load_linuxcnc, OPCUA: load_opcua, MTCONNECT: load_mtconnect}


def test_values_are_in_si(tmp_path: Path) -> None:
    path = tmp_path / 'cnc.yaml'
    path.write_text(LINUXCNC)
    file = load_linuxcnc(str(path))
    assert (file.host, file.port, file.rate, file.enable_password) == ('10.0.0.5', 5007, 250.0, '')
    assert [axis.name for axis in file.axes] == ['X', 'Y', 'B']
    assert [axis.scale for axis in file.axes] == pytest.approx([1e-3, -0.0254, -math.pi / 180])
    path.write_text(OPCUA + 'period_ms: 10\nskew_ms: 2\nstamp: arrival\n'
                    'estop: {node: "ns=2;s=E", value: true}')
    opcua = load_opcua(str(path))
    assert opcua.link.period == pytest.approx(0.01) and opcua.together == 2_000_000
    assert not opcua.source_stamps and opcua.estop is True
    assert opcua.link.nodes['estop'] == 'ns=2;s=E'


@pytest.mark.parametrize(
    ('text', 'old', 'new', 'said'),
    [
        (LINUXCNC, 'rate_hz', 'rate', "unknown key 'rate'"),
        (LINUXCNC, '250', 'fast', 'rate_hz: expected'),
        (LINUXCNC, 'unit: deg', 'unit: degrees', 'axes: B: unit: expected one of'),
        (LINUXCNC, 'unit: deg', 'unit: mm', 'axes: B: unit: mm is no unit of the rotary axis B'),
        (LINUXCNC, 'X: {index: 0, unit: mm}', 'X: {index: 0, unit: deg}', 'no unit of the linear'),
        (LINUXCNC, 'index: 3', 'index: 1', 'axes: Y and B: the same index 1'),
        (LINUXCNC, 'index: 3, ', '', 'axes: B: index: missing'),
        (LINUXCNC, 'index: 3', 'index: 3.5', 'axes: B: index: expected a whole number'),
        (LINUXCNC, 'sign: -1}\n  B', 'sign: 2}\n  B', 'axes: Y: sign: expected 1 or -1'),
        (LINUXCNC, 'sign: -1}\n  B', 'sign: 1.0}\n  B', 'axes: Y: sign: expected 1 or -1'),
        (LINUXCNC, 'host: 10.0.0.5', 'rate_hz: 5', 'not valid YAML: a key is there twice'),
        (LINUXCNC, '  B:', '  X:', 'not valid YAML: a key is there twice'),
        (LINUXCNC, 'B: {', 'b: {', 'axes: b: expected a capital letter'),
        (LINUXCNC, 'host: 10.0.0.5', 'host: 5', 'host: expected a text'),
        (LINUXCNC, '10.0.0.5', 'a..b', "host: expected the name or address of a host, got 'a..b'"),
        (LINUXCNC, '10.0.0.5', 'a' * 64 + '.x', 'host: expected the name or address of a host'),
        (LINUXCNC, '10.0.0.5', '"a\\0b"', 'host: expected the name or address of a host'),
        (LINUXCNC, 'host: 10.0.0.5', 'password: a b', 'password: linuxcncrsh takes no'),
        (LINUXCNC, 'axes:', 'axes: [', 'not valid YAML'),
        (OPCUA, 'url:', 'port: 1\nur:', "unknown key 'port'"),
        (OPCUA, 'url: opc.tcp://10.0.0.6:4840', 'stamp: now', 'url: missing'),
        *((OPCUA, 'opc.tcp://10.0.0.6:4840', url, f'expected opc.tcp://HOST:PORT, got {url!r}')
          for url in ('http://10.0.0.6:4840', 'nonsense', 'opc.tcp://10.0.0.6', 'opc.tcp://a:b',
                      'opc.tcp://a:99999', 'opc.tcp://a..b:4840', 'opc.tcp://:4840')),
        *((OPCUA, 'url', f'security: "{text}"\nurl', 'security: expected POLICY,MODE,CERTIFICATE')
          for text in ('x', 'Foo,Sign,a,b', 'Basic256Sha256,Foo,a,b', 'Basic256Sha256,Sign,a,')),
        (OPCUA, 'url', 'estop: {node: x, value: [1]}\nurl', 'estop: value: expected true, false'),
        (OPCUA, 'url', 'stamp: now\nurl', "stamp: expected one of ['source', 'arrival']"),
        (OPCUA, 'url', 'estop: {node: x}\nurl', 'estop: value: missing'),
        (OPCUA, ', unit: mm', '', 'axes: X: unit: missing'),
        (MTCONNECT, 'http://10.0.0.7:5000', 'ftp://10.0.0.7', 'url: expected http://HOST:PORT'),
        (MTCONNECT, 'http://10.0.0.7:5000', 'http://a:b', 'url: expected http://HOST:PORT'),
        *((MTCONNECT, 'http://10.0.0.7:5000', url, f'of an MTConnect agent, got {url!r}')
          for url in ('http://a..b', 'http://h/é', 'http://[::1:5000', 'http://h/a b',
                      'http://' + 'a' * 64, 'http://h:0')),
        (MTCONNECT, 'url', 'period_ms: 0.1\nurl', 'period_ms: expected 5 to 1000'),
    ],
)
def test_mistakes_are_one_line_with_file_and_key(
    tmp_path: Path, text: str, old: str, new: str, said: str
) -> None:
    path = tmp_path / 'cnc.yaml'
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(UserError) as caught:
        LOADERS[text](str(path))
    assert said in str(caught.value) and str(path) in str(caught.value)
    assert '\n' not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(UserError, match='cannot read the device file'):
        load_linuxcnc(str(tmp_path / 'none.yaml'))
