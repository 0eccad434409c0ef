// One job: progress, stages, log.

import { useEffect, useRef, useState } from "preact/hooks";

import { send, troubleOf } from "../api";
import type { ServerEvent } from "../events";
import { about, bytes, duration, millimeters, moment, percent } from "../format";
import { go, useEvents, useEvery, useFetched, useThrottled, useTitle } from "../hooks";
import { Badge, Bar, Card, Facts, Trouble } from "../parts/basic";
import { Log } from "../parts/log";
import { Restart } from "../parts/restart";
import { LevelBadge } from "../parts/verdict";
import { grouped, stateOf, Timeline } from "../parts/stages";
import type { Dataset, Job, Stage } from "../types";

const ENDED = new Set(["done", "failed", "canceled"]);

export function JobView({ id }: { id: string }) {
  const [leaving, setLeaving] = useState(false);
  const fetched = useFetched<Job>(leaving ? null : `/v1/jobs/${id}`);
  const [live, setLive] = useState<LiveJob>({});
  const [round, setRound] = useState(0);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const refresh = useThrottled(fetched.again, 250);
  const ended = fetched.data !== null && ENDED.has(fetched.data.state);
  const up = useEvents(leaving || fetched.data === null ? null : `/v1/jobs/${id}/events?after=0&round=${String(round)}`, (event) => {
    if (event.event === "progress" || event.event === "log") setLive((old) => ({ ...old, ...patch(event) }));
    else refresh();
  });
  const { state = "", name: called = "Job" } = fetched.data ?? {};
  useTitle(state === "running" ? `${percent(live.progress ?? fetched.data?.progress ?? 0)} ${called}` : `${called}: ${state}`);
  const dataset = useFetched<Dataset>(fetched.data === null ? null : `/v1/datasets/${fetched.data.dataset}`);
  useEffect(() => { setLive({}); }, [fetched.data]);
  // Asked for only after all that asks about the job has stopped: nobody asks for what is gone.
  useEffect(() => {
    if (!leaving) return;
    send("DELETE", `/v1/jobs/${id}`).then(
      () => { go("jobs"); },
      (error: unknown) => {
        setTrouble(troubleOf(error));
        setLeaving(false);
      },
    );
  }, [leaving, id]);
  useEvery(ended ? null : up ? 5000 : 2000, fetched.again);
  if (fetched.data === null) return <Trouble trouble={fetched.trouble} />;
  const log_bytes = Math.max(fetched.data.log_bytes ?? 0, live.log_bytes ?? 0);
  const job: Job = { ...fetched.data, ...live, log_bytes, stages: shownStages(fetched.data) };
  const again = (): void => {
    setTrouble(null);
    fetched.again();
    setRound((n) => n + 1);
  };
  const cancel = (): void => {
    send("POST", `/v1/jobs/${id}/cancel`).then(again, (error: unknown) => { setTrouble(troubleOf(error)); });
  };
  if (leaving) return <p class="quiet" role="status">Deleting {job.name}…</p>;
  return (
    <>
      <div class="page-head">
        <div>
          <p class="crumb"><a href="#/jobs">Jobs</a></p>
          <h1>{job.name === "" ? job.id : job.name} <Badge state={job.state} /></h1>
        </div>
        <Actions job={job} cancel={cancel} remove={() => { setLeaving(true); }} restarted={again} />
      </div>
      <Trouble trouble={trouble} />
      {job.error !== null && <Trouble trouble={job.error} />}
      <Head job={job} up={up} />
      <div class="columns job-columns">
        <Card title="Stages" id="stages">
          {(job.stages ?? []).length === 0 ? <p class="quiet">{job.state === "queued" ? "The job waits for its turn." : "The stages are listed when the run starts."}</p> : <Timeline stages={withLive(job.stages ?? [], live)} />}
        </Card>
        <div>
          <Card title="Log" id="log"><Log key={String(job.attempts?.length ?? 0)} job={id} size={job.log_bytes ?? 0} /></Card>
          <Card title="About" id="about"><About job={job} dataset={dataset.data?.name ?? job.dataset} /></Card>
        </div>
      </div>
    </>
  );
}

interface LiveJob extends Partial<Job> {
  now?: { stage: string; what: string; done: number; total: number };
}

function patch(event: ServerEvent): LiveJob {
  const { data } = event;
  const number = (name: string): number | null => (typeof data[name] === "number" ? data[name] : null);
  if (event.event === "log") return { log_bytes: number("bytes") ?? 0 };
  return {
    progress: number("fraction") ?? 0,
    eta_s: number("eta_s"),
    now: { stage: String(data["stage"]), what: String(data["what"]), done: number("done") ?? 0, total: number("total") ?? 0 },
  };
}

/** Nothing of a canceled job has failed, whatever earlier versions of the server wrote down. */
function shownStages(job: Job): Stage[] {
  const stages = job.stages ?? [];
  return job.state === "canceled" ? stages.map((stage) => (stage.state === "failed" ? { ...stage, state: "stopped" } : stage)) : stages;
}

function withLive(stages: Stage[], live: LiveJob): Stage[] {
  const { now } = live;
  if (now === undefined) return stages;
  return stages.map((stage) => (stage.name === now.stage && stage.state !== "done" ? { ...stage, state: "running", what: now.what, done: now.done, total: now.total } : stage));
}

function Head({ job, up }: { job: Job; up: boolean }) {
  const active = !ENDED.has(job.state);
  const tens = Math.floor(job.progress * 10) * 10;
  return (
    <section class="card job-now" aria-label="Progress">
      {active && <Bar fraction={job.state === "queued" ? 0 : job.progress} label="Progress of the job" />}
      <div class="big-facts">
        {active && <Big name="Done" value={percent(job.progress)} />}
        {job.state === "running" && <Step job={job} />}
        {active && job.eta_s !== null && <Big name="Left" value={about(job.eta_s)} />}
        <Big name={active ? "Running for" : "Took"} value={duration(job.elapsed_s)} />
        {job.state === "queued" && <Big name="In the queue" value={job.position ? `${String(job.position)} before it` : "next"} />}
        {job.summary?.verdict && <div class="big"><span class="big-value"><LevelBadge level={job.summary.verdict} /></span><span class="quiet small">Verdict</span></div>}
        {typeof job.summary?.map_error_m === "number" && <Big name="Map, expected error" value={millimeters(job.summary.map_error_m)} />}
        {job.summary && <Gains job={job} />}
        {job.state === "done" && <a class="button primary large" href={`#/jobs/${job.id}/result`}>See the result</a>}
      </div>
      {!up && active && <p class="quiet small">The live connection is down; asking every few seconds instead.</p>}
      <p class="visually-hidden" role="status">{active ? `${job.state}, ${String(tens)} percent` : `The job is ${job.state}`}</p>
    </section>
  );
}

/** Which stage it is at: the count of the timeline. */
function Step({ job }: { job: Job }) {
  const groups = grouped(job.stages ?? []);
  const at = groups.findIndex((group) => stateOf(group) === "running");
  return at < 0 ? null : <Big name="Stage" value={`${String(at + 1)} of ${String(groups.length)}`} />;
}

function Gains({ job }: { job: Job }) {
  const { psnr_before: before = null, psnr_after: after = null } = job.summary ?? {};
  if (before === null || after === null) return null;
  return <Big name="PSNR, leave-one-out" value={`${before.toFixed(1)} → ${after.toFixed(1)} dB`} />;
}

function Big({ name, value }: { name: string; value: string }) {
  return <div class="big"><span class="big-value">{value}</span><span class="quiet small">{name}</span></div>;
}

function Actions({ job, cancel, remove, restarted }: { job: Job; cancel: () => void; remove: () => void; restarted: () => void }) {
  const dialog = useRef<HTMLDialogElement>(null);
  const ended = ENDED.has(job.state);
  return (
    <div class="actions">
      {!ended && <button type="button" disabled={job.state === "canceling"} onClick={cancel}>Cancel</button>}
      {ended && <Restart job={job} done={restarted} />}
      {ended && <button type="button" class="danger" onClick={() => { dialog.current?.showModal(); }}>Delete</button>}
      <dialog ref={dialog} aria-labelledby="delete-title">
        <h2 id="delete-title">Delete {job.name}?</h2>
        <p>This deletes its result and all intermediate results. The recording stays.</p>
        <div class="actions">
          <button type="button" onClick={() => { dialog.current?.close(); }}>Keep it</button>
          <button type="button" class="danger" onClick={remove}>Delete</button>
        </div>
      </dialog>
    </div>
  );
}

function About({ job, dataset }: { job: Job; dataset: string }) {
  const { estimate } = job;
  const changed = job.config !== null && Object.keys(job.config).length > 0;
  return (
    <>
      <Facts
        rows={[
          ["Recording", <a href={`#/new/${job.dataset}`} title="New job with it">{dataset}</a>],
          ["Created", moment(job.created)], ["Started", moment(job.started)], ["Ended", moment(job.finished)],
          ...(estimate ? [["Estimated", `${duration(estimate.seconds)}, ${bytes(estimate.memory_bytes)} memory${estimate.basis === undefined ? "" : `, from ${estimate.basis}`}`] as [string, string]] : []),
        ]}
      />
      {job.import !== null && job.import !== undefined && Object.keys(job.import).length > 0 && <details class="more"><summary>Choices of the import</summary><pre class="small">{JSON.stringify(job.import, null, 1)}</pre></details>}
      {changed && <details class="more"><summary>Changed settings</summary><pre class="small">{JSON.stringify(job.config, null, 1)}</pre></details>}
      {(job.attempts ?? []).length > 1 && (
        <details class="more">
          <summary>{job.attempts?.length} attempts</summary>
          <ol>{job.attempts?.map((attempt) => <li key={attempt.number}>{moment(attempt.started)}: {attempt.outcome ?? "running"} {attempt.message}</li>)}</ol>
        </details>
      )}
    </>
  );
}
