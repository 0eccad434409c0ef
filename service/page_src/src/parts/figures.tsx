// The figures of a result: gains image by image, and which stages were accepted.

import { millimeters, plural } from "../format";
import type { Report, ScoresFacts } from "../types";
import { Card } from "./basic";
import { Chart, type Series } from "./chart";
import { ErrorByFrame } from "./verdict";

export interface Scores {
  images: number[];
  before: (number | null)[];
  after: (number | null)[];
  of: (image: number) => { before: number | null; after: number | null };
}

export function scoresOf(report: Report | null): Scores {
  const { rough, refined } = report?.evaluation ?? {};
  const images = refined?.images ?? [];
  const [before, after] = [rough, refined].map((scores) => scores?.per_image?.["psnr_leave_one_out"] ?? []);
  const of = (image: number): { before: number | null; after: number | null } => {
    const place = images.indexOf(image);
    return { before: before?.[place] ?? null, after: after?.[place] ?? null };
  };
  return { images, before: before ?? [], after: after ?? [], of };
}

export function Headline({ report }: { report: Report }) {
  const { rough, refined } = report.evaluation ?? {};
  const truth = report.reference;
  const rows: [string, string, string][] = [];
  const add = (name: string, before: number | null | undefined, after: number | null | undefined, show: (value: number) => string): void => {
    if (before !== null && before !== undefined && after !== null && after !== undefined) rows.push([name, show(before), show(after)]);
  };
  add("PSNR, leave-one-out", rough?.psnr_leave_one_out, refined?.psnr_leave_one_out, (value) => `${value.toFixed(1)} dB`);
  add("SSIM, leave-one-out", rough?.ssim_leave_one_out, refined?.ssim_leave_one_out, (value) => value.toFixed(2));
  add("Map entropy", rough?.map_entropy, refined?.map_entropy, (value) => value.toFixed(2));
  add("Scans, error against the reference", truth?.rough?.lidar?.ate_m, truth?.lidar?.ate_m, millimeters);
  add("Cameras, error against the reference", truth?.rough?.camera?.ate_m, truth?.camera?.ate_m, millimeters);
  return (
    <ul class="headline" aria-label="The input and the result">
      {rows.map(([name, before, after]) => (
        <li key={name}>
          <span class="quiet small">{name}</span>
          <span class="headline-values"><span class="quiet">{before}</span> <span aria-label="to">→</span> <strong>{after}</strong></span>
        </li>
      ))}
    </ul>
  );
}

export function Figures({ report, image, choose }: { report: Report; image: number | null; choose: (image: number) => void }) {
  const scores = scoresOf(report);
  const { times = [], relative = [], reference = [] } = report.exposure ?? {};
  const exposure: Series[] = [{ name: "solved", values: relative, kind: "after" }];
  if (reference.length > 0) exposure.unshift({ name: "reference", values: reference, kind: "reference" });
  const place = image === null ? null : scores.images.indexOf(image);
  return (
    <div class="columns">
      <ErrorByFrame report={report} image={image} choose={choose} />
      {scores.images.length > 0 && (
        <Card title="How well the map predicts each image" id="psnr">
          <Chart
            title="PSNR, leave-one-out" unit="dB" xName="image" labels={scores.images.map(String)} chosen={place === -1 ? null : place}
            choose={(at) => { choose(scores.images[at] ?? 0); }}
            series={[{ name: "before", values: scores.before, kind: "before" }, { name: "after", values: scores.after, kind: "after" }]}
          />
        </Card>
      )}
      {times.length > 0 && (
        <Card title="Exposures" id="exposures">
          <Chart title="Relative exposure" unit="" xName="image" labels={times.map((_, at) => String(at))} chosen={image} choose={choose} series={exposure} />
        </Card>
      )}
      <Kept report={report} />
    </div>
  );
}

/** What is refined in each state that was judged, from the input on. */
const STATES: [string, string][] = [
  ["rough", "The input"], ["carried", "Scans (cameras moved with them)"], ["exposed", "Scans and exposures"],
  ["fused_carried", "Scans, refined with the cameras"], ["fused_exposed", "Scans, refined with the cameras, and exposures"], ["posed", "Scans and cameras"],
  ["visual", "Scans, cameras and exposures"], ["fused_posed", "Scans and cameras, scans refined with the cameras"],
  ["fused", "All of these, scans refined with the cameras"],
];

function Kept({ report }: { report: Report }) {
  const rows: [string, boolean | null | undefined, string | undefined][] = [
    ["Scans", report.lidar?.accepted, report.lidar?.reason], ["Exposures", report.visual?.exposures_accepted, report.visual?.exposures_reason],
    ["Cameras", report.visual?.accepted, report.visual?.reason], ["Scans refined with the cameras", report.fusion?.accepted, report.fusion?.reason],
  ];
  const explained = rows.filter(([, , reason]) => reason !== undefined && reason !== "");
  const warnings = report.warnings ?? [];
  if (explained.length === 0 && warnings.length === 0) return null;
  return (
    <Card title="Acceptance of stages" id="kept">
      <p class="quiet small">Each stage is compared with the state before it and accepted only where it improves that state. The figures at the top compare the whole result with the input.</p>
      <Steps states={report.evaluation?.states ?? {}} result={report.visual?.state ?? ""} />
      <ul class="plain kept">
        {explained.map(([name, accepted, reason]) => (
          <li key={name}>
            <strong>{name}</strong> {accepted === true ? <span class="tag tag-good">✓ accepted</span> : accepted === false ? <span class="tag">– rejected</span> : null}
            <span class="quiet small">{reason}</span>
          </li>
        ))}
      </ul>
      {warnings.length > 0 && <details class="more"><summary>{plural(warnings.length, "warning")}</summary><ul>{warnings.map((warning) => <li key={warning}>{warning}</li>)}</ul></details>}
    </Card>
  );
}

/** The same score after each stage: the numbers in the reason of a stage are in the row above it. */
function Steps({ states, result }: { states: Record<string, ScoresFacts>; result: string }) {
  const known = STATES.filter(([name]) => typeof states[name]?.psnr_leave_one_out === "number");
  if (known.length < 2) return null;
  return (
    <table class="steps">
      <thead><tr><th scope="col">Refined</th><th scope="col">PSNR, leave-one-out</th></tr></thead>
      <tbody>
        {known.map(([name, words]) => <tr key={name}><th scope="row">{words} {name === result && <span class="tag tag-good">the result</span>}</th><td>{states[name]?.psnr_leave_one_out?.toFixed(1)} dB</td></tr>)}
      </tbody>
    </table>
  );
}
