// What came out: the map in 3D, pictures, figures and files.

import { useEffect, useRef, useState } from "preact/hooks";

import type { Viewer } from "../cloud/viewer";
import { get, ticket, withQuery } from "../api";
import { bytes, length, plural } from "../format";
import { useEvery, useFetched, useTitle } from "../hooks";
import { Card, Trouble } from "../parts/basic";
import { Chart, type Series } from "../parts/chart";
import { CloudView } from "../parts/cloud";
import { Compare } from "../parts/compare";
import type { Artifact, Frame, Job, Page, Report } from "../types";

export default function Result({ id }: { id: string }) {
  const base = `/v1/jobs/${id}/results/`;
  const job = useFetched<Job>(`/v1/jobs/${id}`);
  const report = useFetched<Report>(`${base}report.json`);
  const artifacts = useFetched<Artifact[]>(`/v1/jobs/${id}/results`, async (path) => (await get<Page<Artifact>>(path)).items);
  const frames = useFetched<Frame[]>(`/v1/jobs/${id}/frames`, async (path) => (await get<Page<Frame>>(path)).items);
  useTitle(`${job.data?.name ?? "Result"}: result`);
  const query = useTicket(`/v1/jobs/${id}/`);
  const viewer = useRef<Viewer | null>(null);
  const [image, setImage] = useState<number | null>(null);
  const names = new Set((artifacts.data ?? []).map((one) => one.name));
  const has3d = names.has("cloud/metadata.json");
  const scores = scoresOf(report.data);
  const total = frames.data?.length ?? 0;
  const choose = (wanted: number): void => { setImage(total === 0 ? null : Math.max(0, Math.min(total - 1, Math.round(wanted)))); };
  const step = (by: number): void => {
    const shown = (frames.data ?? []).filter((frame) => frame.after !== null).map((frame) => frame.index);
    const places = shown.length > 0 ? shown : (frames.data ?? []).map((frame) => frame.index);
    const next = by > 0 ? places.find((place) => place > (image ?? -1)) : places.findLast((place) => place < (image ?? 0));
    choose(next ?? (by > 0 ? (places[0] ?? 0) : (places.at(-1) ?? 0)));
  };
  return (
    <>
      <div class="page-head">
        <div>
          <p class="crumb"><a href="#/jobs">Jobs</a> / <a href={`#/jobs/${id}`}>{job.data?.name ?? id}</a></p>
          <h1>{job.data?.name ?? "Result"}</h1>
        </div>
        <div class="actions">
          {names.has("report.html") && query !== null && <a class="button" target="_blank" rel="noopener" href={withQuery(`${base}report.html`, query)}>Report</a>}
          {query !== null && <a class="button primary" href={withQuery(`/v1/jobs/${id}/archive`, query)} download>Download all</a>}
        </div>
      </div>
      <Trouble trouble={job.trouble ?? artifacts.trouble} />
      {report.data !== null && <Headline report={report.data} />}
      <div class={`stage${image === null ? "" : " stage-split"}`}>
        {has3d && <CloudView url={(name) => `${base}cloud/${name}`} cameras={names.has("cloud/cloud.json")} chosen={image} choose={choose} control={(made) => { viewer.current = made; }} />}
        {!has3d && artifacts.data !== null && <div class="cloud cloud-problem"><p>This result has no map for the browser; map.ply is below.</p></div>}
        {image !== null && query !== null && (
          <Compare
            image={image} count={total} name={baseName(frames.data?.[image]?.raw ?? "")} pictures={pictures(frames.data?.[image], base, names, query)}
            scores={scores.of(image)} choose={choose} step={step} fly={has3d ? () => { viewer.current?.flyTo(image); } : null} close={() => { setImage(null); }}
          />
        )}
      </div>
      {image === null && total > 0 && <p><button type="button" onClick={() => { step(1); }}>Compare photographs with the map</button> <span class="quiet small">or click a camera in the map</span></p>}
      {report.data !== null && <Figures report={report.data} image={image} choose={choose} />}
      <Downloads artifacts={artifacts.data ?? []} query={query} />
    </>
  );
}

/** The query for addresses that the browser opens by itself; made anew before it runs out. */
function useTicket(path: string): string | null {
  const [query, setQuery] = useState<string | null>(null);
  const fetchOne = (): void => { void ticket(path).then(setQuery, () => { setQuery(""); }); };
  useEffect(fetchOne, [path]);
  useEvery(600_000, fetchOne);
  return query;
}

function baseName(url: string): string {
  return decodeURIComponent(url.split("?")[0]?.split("/").pop() ?? "");
}

/** The photograph without distortion, where there is one: it lies over the rendered map pixel by pixel. */
function pictures(frame: Frame | undefined, base: string, names: Set<string>, query: string): Partial<Record<"photo" | "before" | "after", string>> {
  if (frame === undefined) return {};
  const plain = `frames/photo/${String(frame.index).padStart(6, "0")}.jpg`;
  const photo = names.has(plain) ? base + plain : frame.raw;
  const found = Object.entries({ photo, before: frame.before, after: frame.after }).filter(([, url]) => url !== null);
  return Object.fromEntries(found.map(([kind, url]) => [kind, withQuery(url ?? "", query)]));
}

interface Scores {
  images: number[];
  before: (number | null)[];
  after: (number | null)[];
  of: (image: number) => { before: number | null; after: number | null };
}

function scoresOf(report: Report | null): Scores {
  const { rough, refined } = report?.evaluation ?? {};
  const images = refined?.images ?? [];
  const [before, after] = [rough, refined].map((scores) => scores?.per_image?.["psnr_leave_one_out"] ?? []);
  const of = (image: number): { before: number | null; after: number | null } => {
    const place = images.indexOf(image);
    return { before: before?.[place] ?? null, after: after?.[place] ?? null };
  };
  return { images, before: before ?? [], after: after ?? [], of };
}

function Headline({ report }: { report: Report }) {
  const { rough, refined } = report.evaluation ?? {};
  const truth = report.reference;
  const rows: [string, string, string][] = [];
  const add = (name: string, before: number | null | undefined, after: number | null | undefined, show: (value: number) => string): void => {
    if (before !== null && before !== undefined && after !== null && after !== undefined) rows.push([name, show(before), show(after)]);
  };
  add("PSNR of images left out", rough?.psnr_leave_one_out, refined?.psnr_leave_one_out, (value) => `${value.toFixed(1)} dB`);
  add("SSIM of images left out", rough?.ssim_leave_one_out, refined?.ssim_leave_one_out, (value) => value.toFixed(2));
  add("Map entropy", rough?.map_entropy, refined?.map_entropy, (value) => value.toFixed(2));
  add("Scans off the reference", truth?.rough?.lidar?.ate_m, truth?.lidar?.ate_m, length);
  add("Cameras off the reference", truth?.rough?.camera?.ate_m, truth?.camera?.ate_m, length);
  return (
    <ul class="headline" aria-label="Before and after">
      {rows.map(([name, before, after]) => (
        <li key={name}>
          <span class="quiet small">{name}</span>
          <span class="headline-values"><span class="quiet">{before}</span> <span aria-label="to">→</span> <strong>{after}</strong></span>
        </li>
      ))}
    </ul>
  );
}

function Figures({ report, image, choose }: { report: Report; image: number | null; choose: (image: number) => void }) {
  const scores = scoresOf(report);
  const { times = [], relative = [], reference = [] } = report.exposure ?? {};
  const exposure: Series[] = [{ name: "solved", values: relative, kind: "after" }];
  if (reference.length > 0) exposure.unshift({ name: "reference", values: reference, kind: "reference" });
  const place = image === null ? null : scores.images.indexOf(image);
  return (
    <div class="columns">
      {scores.images.length > 0 && (
        <Card title="How well the map predicts each image" id="psnr">
          <Chart
            title="PSNR, image left out" unit="dB" xName="image" labels={scores.images.map(String)} chosen={place === -1 ? null : place}
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
      <Verdicts report={report} />
    </div>
  );
}

function Verdicts({ report }: { report: Report }) {
  const rows = [["Scans", report.lidar?.reason], ["Cameras", report.visual?.reason]].filter(([, reason]) => reason !== undefined && reason !== "");
  const warnings = report.warnings ?? [];
  if (rows.length === 0 && warnings.length === 0) return null;
  return (
    <Card title="What was kept" id="kept">
      <ul class="plain">{rows.map(([name, reason]) => <li key={name}><strong>{name}</strong>: {reason}</li>)}</ul>
      {warnings.length > 0 && <details class="more"><summary>{plural(warnings.length, "warning")}</summary><ul>{warnings.map((warning) => <li key={warning}>{warning}</li>)}</ul></details>}
    </Card>
  );
}

const TOLD: Record<string, string> = {
  "map.ply": "the colored map", "lidar_poses.txt": "scan poses, TUM", "image_poses.txt": "camera poses, TUM", "exposures.csv": "relative exposures",
  "report.html": "the report for people", "report.json": "the report for programs", "config.yaml": "every setting",
};

function Downloads({ artifacts, query }: { artifacts: Artifact[]; query: string | null }) {
  const own = artifacts.filter((one) => !one.name.startsWith("cloud/") && !one.name.startsWith("frames/"));
  if (own.length === 0 || query === null) return null;
  return (
    <Card title="Files" id="files">
      <ul class="files">
        {own.map((one) => (
          <li key={one.name}>
            <a href={withQuery(one.url, "download=1", query)} download>{one.name}</a>
            <span class="quiet small">{TOLD[one.name] ?? ""}</span>
            <span class="quiet small number">{bytes(one.bytes)}</span>
          </li>
        ))}
      </ul>
    </Card>
  );
}
