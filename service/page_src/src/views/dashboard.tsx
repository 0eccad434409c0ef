// All jobs, as they are right now.

import { useMemo, useState } from "preact/hooks";

import { all } from "../api";
import { about, ago, bytes, duration, moment, percent } from "../format";
import { useEvents, useEvery, useFetched, useThrottled, useTitle } from "../hooks";
import { Badge, Bar, Empty, Segments, Trouble } from "../parts/basic";
import { LevelBadge } from "../parts/verdict";
import type { Dataset, Info, Job, JobState } from "../types";

type Filter = "all" | "active" | "done" | "failed";
const MATCHES: Record<Filter, (state: JobState) => boolean> = {
  all: () => true,
  active: (state) => state === "queued" || state === "running" || state === "canceling",
  done: (state) => state === "done",
  failed: (state) => state === "failed" || state === "canceled",
};

export function Dashboard() {
  const jobs = useFetched<Job[]>("/v1/jobs", (path) => all<Job>(path));
  const info = useFetched<Info>("/v1/info");
  const [filter, setFilter] = useState<Filter>("all");
  const [query, setQuery] = useState("");
  useTitle("Jobs");
  const refresh = useThrottled(jobs.again, 700);
  const up = useEvents("/v1/events", refresh);
  useEvery(up ? 20_000 : 4000, jobs.again);
  const listed = jobs.data ?? [];
  const shown = useMemo(
    () => listed.filter((job) => MATCHES[filter](job.state) && matches(job, query)),
    [listed, filter, query],
  );
  const count = (name: Filter): string => String(listed.filter((job) => MATCHES[name](job.state)).length);
  return (
    <>
      <div class="page-head">
        <h1>Jobs</h1>
        <a class="button primary" href="#/new">New job</a>
      </div>
      <div class="toolbar">
        <Segments
          label="Show" value={filter} choose={setFilter}
          options={[["all", `All ${count("all")}`], ["active", `Active ${count("active")}`], ["done", `Done ${count("done")}`], ["failed", `Stopped ${count("failed")}`]]}
        />
        <input
          type="search" aria-label="Filter by name" placeholder="Filter by name" value={query}
          onInput={(event) => { setQuery(event.currentTarget.value); }}
        />
        {info.data !== null && (
          <span class="quiet toolbar-end">
            {info.data.running} running, {info.data.queued} waiting · {bytes(info.data.disk_free_bytes)} free
          </span>
        )}
      </div>
      <Trouble trouble={jobs.trouble} />
      <Announcer jobs={listed} />
      {jobs.data !== null && shown.length === 0 && (
        <Empty title={listed.length === 0 ? "No jobs yet" : "No job matches"}>
          {listed.length === 0 && <p>Send a recording, and watch it become a map. <a href="#/new">Start the first job</a></p>}
        </Empty>
      )}
      {shown.length > 0 && <Table jobs={shown} />}
    </>
  );
}

function matches(job: Job, query: string): boolean {
  const text = `${job.name} ${job.id} ${job.dataset}`.toLowerCase();
  return query.toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

export function Table({ jobs }: { jobs: Job[] }) {
  const datasets = useFetched<Dataset[]>("/v1/datasets", (path) => all<Dataset>(path));
  const names = new Map((datasets.data ?? []).map((dataset) => [dataset.id, dataset.name]));
  return (
    <div class="table-frame">
      {/* roles: on a phone the rows are laid out as cards, and browsers then take the table for none */}
      <table class="jobs" role="table">
        <thead role="rowgroup">
          <tr role="row"><th role="columnheader" scope="col">Job</th><th role="columnheader" scope="col">State</th><th role="columnheader" scope="col">Progress</th><th role="columnheader" scope="col">Better by</th><th role="columnheader" scope="col">Verdict</th><th role="columnheader" scope="col">Created</th><td role="cell" /></tr>
        </thead>
        <tbody role="rowgroup">
          {jobs.map((job) => <Row key={job.id} job={job} dataset={names.get(job.dataset) ?? job.dataset} />)}
        </tbody>
      </table>
    </div>
  );
}

function Row({ job, dataset }: { job: Job; dataset: string }) {
  const active = MATCHES.active(job.state);
  return (
    <tr role="row">
      <th role="rowheader" scope="row">
        <a class="row-link" href={`#/jobs/${job.id}`}>{job.name === "" ? job.id : job.name}</a>
        <span class="quiet small">{dataset}</span>
      </th>
      <td role="cell" class="state-cell"><Badge state={job.state} /></td>
      <td role="cell" class="progress-cell">
        {active && <Bar fraction={job.state === "queued" ? 0 : job.progress} label={`Progress of ${job.name}`} />}
        <span class="quiet small">{rest(job)}</span>
      </td>
      <td role="cell" class="number gain-cell">{gain(job)}</td>
      <td role="cell" class="level-cell">{job.summary?.verdict && <LevelBadge level={job.summary.verdict} />}</td>
      <td role="cell" class="quiet created-cell" title={moment(job.created)}>{ago(job.created)}</td>
      <td role="cell" class="result-cell">{job.state === "done" && <a href={`#/jobs/${job.id}/result`} aria-label={`Result of ${job.name}`}>Result</a>}</td>
    </tr>
  );
}

function rest(job: Job): string {
  if (job.state === "queued") return job.position ? `${String(job.position)} before it` : "next";
  if (job.state === "running" && job.progress >= 1) return "finishing";
  if (job.state === "running") return job.eta_s === null ? percent(job.progress) : `${percent(job.progress)}, ${about(job.eta_s)} left`;
  if (job.state === "failed") return job.error?.cause ?? "";
  return job.elapsed_s === null ? "" : `took ${duration(job.elapsed_s)}`;
}

function gain(job: Job): string {
  const { psnr_before: before = null, psnr_after: after = null } = job.summary ?? {};
  return before === null || after === null ? "" : `${after >= before ? "+" : "−"}${Math.abs(after - before).toFixed(1)} dB`;
}

/** Tells screen readers when a job changes its state. */
function Announcer({ jobs }: { jobs: Job[] }) {
  const [known] = useState(new Map<string, JobState>());
  const news = jobs.filter((job) => known.has(job.id) && known.get(job.id) !== job.state);
  for (const job of jobs) known.set(job.id, job.state);
  return <p class="visually-hidden" role="status">{news.map((job) => `${job.name}: ${job.state}`).join(". ")}</p>;
}
