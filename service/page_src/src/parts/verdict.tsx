// The verdict, the expected errors, and the reasons.

import { millimeters, plural } from "../format";
import type { ExpectedError, Level, Report } from "../types";
import { Card } from "./basic";
import { Chart } from "./chart";

const WORDS: Record<Level, [string, string, string]> = {
  good: ["✓", "Good", "no check contradicts the expected errors"],
  check: ["!", "Check", "read the reasons before you use it"],
  bad: ["✕", "Bad", "do not rely on it"],
};
const SHOWN = 2;

/** The level as icon and word; the color is never all that tells it. */
export function LevelBadge({ level }: { level: Level }) {
  const [icon, word] = WORDS[level];
  return <span class={`level level-${level}`}><span class="level-icon" aria-hidden="true">{icon}</span>{word}</span>;
}

/** Nothing for results of earlier versions, whose reports have no verdict. */
export function Verdict({ report }: { report: Report }) {
  const { verdict } = report;
  if (verdict === undefined) return null;
  const level: Level = verdict.level in WORDS ? verdict.level : "check";
  return (
    <section class={`card judged judged-${level}`} aria-label="Verdict">
      <div>
        <p class="judged-level"><LevelBadge level={level} /> <span>{WORDS[level][2]}</span></p>
        <p class="judged-summary">{verdict.summary}</p>
        <Reasons reasons={verdict.reasons} />
      </div>
      <Tiles report={report} />
    </section>
  );
}

function Reasons({ reasons }: { reasons: { text: string; mend: string }[] }) {
  const list = (some: typeof reasons) => (
    <ul class="reasons">{some.map((one) => <li key={one.text}>{one.text} <span class="quiet">{one.mend}</span></li>)}</ul>
  );
  const more = reasons.slice(SHOWN);
  return (
    <>
      {reasons.length > 0 && list(reasons.slice(0, SHOWN))}
      {more.length > 0 && <details class="small"><summary>{plural(more.length, "more reason")}</summary>{list(more)}</details>}
    </>
  );
}

function Tiles({ report }: { report: Report }) {
  const { expected_error: expected, planes } = report;
  const more = expected?.at_least === true;
  const parts: [string, ExpectedError | null | undefined, string][] = [["Map", expected?.map, "points"], ["Scans", expected?.scans, "scans"]];
  if ((report.dataset?.images ?? 0) > 0) parts.push(["Cameras", expected?.cameras, "cameras"]);
  return (
    <dl class="tiles">
      {parts.map(([name, error, kind]) => {
        const known = error !== null && error !== undefined;
        return (
          <div key={name}>
            <dt>{name}, expected error</dt>
            <dd><strong>{millimeters(error?.position_m)}</strong></dd>
            <dd class="quiet small">{!known ? (name === "Cameras" ? "not refined: moved with the scans" : "not refined: the input poses") : more ? "perhaps more: see the reasons" : `95 % of ${kind} below ${millimeters(error.position_p95_m)}`}</dd>
          </div>
        );
      })}
      {planes !== undefined && (
        <div>
          <dt>Thickness of planes</dt>
          <dd>{millimeters(planes.thickness_before_m)} <span aria-label="to">→</span> <strong>{millimeters(planes.thickness_after_m)}</strong></dd>
          <dd class="quiet small">before and after, noise of points included</dd>
        </div>
      )}
    </dl>
  );
}

/** Frame by frame. */
export function ErrorByFrame({ report, image, choose }: { report: Report; image: number | null; choose: (image: number) => void }) {
  const { scans, cameras, note } = report.expected_error ?? {};
  const inMm = (values: (number | null)[] | undefined): (number | null)[] => (values ?? []).map((value) => (value === null ? null : value * 1000));
  const [ofScans, ofCameras] = [inMm(scans?.per_frame_m), inMm(cameras?.per_frame_m)];
  if (ofScans.length === 0 && ofCameras.length === 0) return null;
  const labels = (values: unknown[]): string[] => values.map((_, at) => String(at));
  return (
    <Card title="Expected error, frame by frame" id="expected">
      <Chart title="Scans" unit="mm" xName="scan" fromZero labels={labels(ofScans)} series={[{ name: "scans", values: ofScans, kind: "after" }]} />
      <Chart title="Cameras" unit="mm" xName="image" fromZero labels={labels(ofCameras)} series={[{ name: "cameras", values: ofCameras, kind: "after" }]} chosen={image} choose={choose} />
      {note !== undefined && <p class="quiet small">{note}</p>}
    </Card>
  );
}
