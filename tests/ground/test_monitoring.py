"""Rules for Prometheus and dashboards for Grafana, checked by what these products bring along."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prometheus_client.parser import text_string_to_metric_families

from service.monitoring.metrics import Metrics
from tests.ground.openmct import NODE

ROOT = Path(__file__).parents[2]
BRIDGES = ROOT / "replay" / "bridges"
RULES = BRIDGES / "prometheus" / "rules.yaml"
PROMTOOL = shutil.which("promtool")
SCHEMA = ROOT / ".venv" / "grafana" / "node_modules"
pytestmark = pytest.mark.ground

CASES = """
rule_files: [{rules}]
evaluation_interval: 1m
tests:
  - interval: 1m
    input_series:
      - {{series: 'twin_open_anomalies{{twin="sat"}}', values: '0x5 2x10'}}
      - {{series: 'twin_open_alarms{{twin="sat",colour="red"}}', values: '0x5 1x10'}}
      - {{series: 'twin_open_alarms{{twin="sat",colour="yellow"}}', values: '3x15'}}
      - {{series: 'twin_last_sample_timestamp_seconds{{twin="sat"}}', values: '0x60'}}
      - {{series: 'twin_ingest_samples_total{{twin="sat",outcome="accepted"}}', values: '0+60x15 960x60'}}
      - {{series: 'twin_jobs_total{{kind="diagnosis",state="failed"}}', values: '0x5 1x10'}}
    alert_rule_test:
      - {{eval_time: 4m, alertname: TwinAnomaly, exp_alerts: []}}
      - eval_time: 8m
        alertname: TwinAnomaly
        exp_alerts:
          - exp_labels: {{twin: sat, severity: warning}}
            exp_annotations: {{summary: "sat: 2 anomalies last"}}
      - eval_time: 8m
        alertname: TwinLimit
        exp_alerts:
          - exp_labels: {{twin: sat, colour: red, severity: critical}}
            exp_annotations: {{summary: "sat: 1 red limits are exceeded, or forecast to be"}}
      - {{eval_time: 9m, alertname: TwinTelemetryStopped, exp_alerts: []}}
      - eval_time: 20m
        alertname: TwinTelemetryStopped
        exp_alerts:
          - exp_labels: {{twin: sat, severity: warning}}
            exp_annotations: {{summary: "sat: no telemetry for 20m 0s"}}
      - {{eval_time: 15m, alertname: TwinNothingArrives, exp_alerts: []}}
      - eval_time: 45m
        alertname: TwinNothingArrives
        exp_alerts:
          - exp_labels: {{severity: warning}}
            exp_annotations: {{summary: "the service takes in no samples at all"}}
      - eval_time: 8m
        alertname: TwinJobsFail
        exp_alerts:
          - exp_labels: {{kind: diagnosis, state: failed, severity: warning}}
            exp_annotations: {{summary: "a diagnosis failed"}}
"""


@pytest.mark.skipif(PROMTOOL is None, reason="no promtool here: apt-get install prometheus")
def test_prometheus_takes_the_rules_and_they_fire(tmp_path: Path) -> None:
    (tmp_path / "cases.yml").write_text(CASES.format(rules=RULES))
    for arguments in (["check", "rules", str(RULES)], ["test", "rules", str(tmp_path / "cases.yml")]):
        done = subprocess.run([str(PROMTOOL), *arguments], capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (
        "11 rules found"
        in subprocess.run([str(PROMTOOL), "check", "rules", str(RULES)], capture_output=True, text=True).stdout
    )


def test_rules_are_those_of_the_documentation_and_name_metrics_that_there_are() -> None:
    written = re.findall(r"^\| [^|]+ \| `(.+?)` \|$", (ROOT / "docs" / "deployment.md").read_text(), re.MULTILINE)
    rules = [rule["expr"] for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]]
    assert [expr.replace('{job="thermal-twin"}', "") for expr in rules] == written
    families = {family.name for family in text_string_to_metric_families(Metrics().render().decode())}
    for expr in rules:
        for name in re.findall(r"\b((?:twin|process)_\w+)", expr):
            assert name.removesuffix("_total") in families, name


@pytest.mark.skipif(
    NODE is None or not SCHEMA.exists(), reason="no schema of Grafana here: npm install @grafana/schema"
)
@pytest.mark.parametrize("name", ["twin.json", "fleet.json"])
def test_dashboards_fit_the_schema_of_grafana(tmp_path: Path, name: str) -> None:
    """Grafana publishes its schema as types: the compiler checks names, kinds and values of every member of the model."""
    board = json.loads((BRIDGES / "grafana" / "dashboards" / name).read_text())
    (tmp_path / "node_modules").symlink_to(SCHEMA)
    assert compiled(tmp_path, board) == ""
    for wrong in ({"schemaVersion": "39"}, {"graphTooltip": 7}, {"no_such_member": 1}, {"panels": [{"id": "1"}]}):
        assert "error TS" in compiled(tmp_path, board | wrong)  # the check can fail


PLAIN = """import type { Dashboard, DataQuery } from '@grafana/schema';
/** The same with the values of enumerations as they stand in JSON, and queries with what each data source adds. */
type Plain<T> = T extends string ? (string extends T ? T : `${T}`)
  : T extends (infer U)[] ? Plain<U>[]
  : T extends object ? { [K in keyof T]: Plain<T[K]> } & (T extends DataQuery ? Record<string, unknown> : {})
  : T;
"""


def compiled(folder: Path, board: object) -> str:
    """Return what the TypeScript compiler says of a dashboard as a literal of Grafana's type."""
    (folder / "board.ts").write_text(f"{PLAIN}export const board: Plain<Dashboard> = {json.dumps(board)};\n")
    compiler = SCHEMA / "typescript" / "bin" / "tsc"
    flags = ["--noEmit", "--strict", "--skipLibCheck", "--module", "esnext", "--moduleResolution", "bundler"]
    done = subprocess.run([str(NODE), str(compiler), *flags, "board.ts"], cwd=folder, capture_output=True, text=True)
    return done.stdout
