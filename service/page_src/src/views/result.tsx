// The result: the map in 3D, pictures, figures and files.

import { useEffect, useRef, useState } from "preact/hooks";

import type { Viewer } from "../cloud/viewer";
import { get, ticket, withQuery } from "../api";
import { bytes } from "../format";
import { useEvery, useFetched, useTitle } from "../hooks";
import { Card, Trouble } from "../parts/basic";
import { CloudView } from "../parts/cloud";
import { Compare } from "../parts/compare";
import { Figures, Headline, scoresOf } from "../parts/figures";
import { Verdict } from "../parts/verdict";
import type { Artifact, Frame, Page, Report } from "../types";

/** job: whose result it is; null: the one that `lvba view` serves. */
export default function Result({ job: id }: { job: string | null }) {
  const home = id === null ? "/v1/result" : `/v1/jobs/${id}`;
  const base = `${home}/results/`;
  const job = useFetched<{ name: string }>(home);
  const report = useFetched<Report>(`${base}report.json`);
  const artifacts = useFetched<Artifact[]>(`${home}/results`, async (path) => (await get<Page<Artifact>>(path)).items);
  const frames = useFetched<Frame[]>(`${home}/frames`, async (path) => (await get<Page<Frame>>(path)).items);
  useTitle(`${job.data?.name ?? "Result"}: result`);
  const query = useTicket(`${home}/`);
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
          {id !== null && <p class="crumb"><a href="#/jobs">Jobs</a> / <a href={`#/jobs/${id}`}>{job.data?.name ?? id}</a></p>}
          <h1>{job.data?.name ?? "Result"}</h1>
        </div>
        <div class="actions">
          {total > 0 && <button type="button" class="primary" aria-pressed={image !== null} onClick={() => { if (image === null) step(1); else setImage(null); }}>Compare photographs</button>}
          {names.has("report.html") && query !== null && <a class="button" target="_blank" rel="noopener" href={withQuery(`${base}report.html`, query)}>Report</a>}
          {id !== null && query !== null && <a class="button" href={withQuery(`${home}/archive`, query)} download>Download all</a>}
        </div>
      </div>
      <Trouble trouble={job.trouble ?? artifacts.trouble} />
      {report.data !== null && <Verdict report={report.data} />}
      {report.data !== null && report.data.verdict === undefined && <Headline report={report.data} />}
      <div class={`stage${image === null ? "" : " stage-split"}`}>
        {has3d && <CloudView url={(name) => `${base}cloud/${name}`} cameras={names.has("cloud/cloud.json")} most={report.data?.expected_error?.map?.position_p95_m ?? null} chosen={image} choose={choose} control={(made) => { viewer.current = made; }} />}
        {!has3d && artifacts.data !== null && <div class="cloud cloud-problem"><p>This result has no map for the browser; map.ply is below.</p></div>}
        {image !== null && query !== null && (
          <Compare
            image={image} count={total} name={frames.data?.[image]?.name ?? baseName(frames.data?.[image]?.raw ?? "")} pictures={pictures(frames.data?.[image], base, names, query)}
            scores={scores.of(image)} choose={choose} step={step} fly={has3d ? () => { viewer.current?.flyTo(image); } : null} close={() => { setImage(null); }}
          />
        )}
      </div>
      {report.data?.verdict !== undefined && <Headline report={report.data} />}
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
  const known = Object.entries({ photo, before: frame.before, after: frame.after }).filter(([, url]) => url !== null);
  return Object.fromEntries(known.map(([kind, url]) => [kind, withQuery(url ?? "", query)]));
}

const DESCRIPTIONS: Record<string, string> = {
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
            <span class="quiet small">{DESCRIPTIONS[one.name] ?? ""}</span>
            <span class="quiet small number">{bytes(one.bytes)}</span>
          </li>
        ))}
      </ul>
    </Card>
  );
}
