// Batches: many jobs sent together.

import { useState } from "preact/hooks";

import { all, send, troubleOf } from "../api";
import { ago, moment, percent } from "../format";
import { useEvents, useFetched, useThrottled, useTitle } from "../hooks";
import { Bar, Badge, Empty, Trouble } from "../parts/basic";
import type { Batch } from "../types";
import { Table } from "./dashboard";

export function Batches({ id }: { id: string | null }) {
  return id === null ? <List /> : <One key={id} id={id} />;
}

function List() {
  const batches = useFetched<Batch[]>("/v1/batches", (path) => all<Batch>(path));
  useEvents("/v1/events", useThrottled(batches.again, 1500));
  useTitle("Batches");
  return (
    <>
      <div class="page-head"><h1>Batches</h1></div>
      <Trouble trouble={batches.trouble} />
      {batches.data?.length === 0 && (
        <Empty title="No batches yet"><p>A batch sends many recordings at once: <code>lvba batch</code>, or <code>POST /v1/batches</code>.</p></Empty>
      )}
      <ul class="batch-list">
        {batches.data?.map((batch) => (
          <li key={batch.id} class="card">
            <a class="row-link" href={`#/batches/${batch.id}`}>{batch.name === "" ? batch.id : batch.name}</a>
            <Bar fraction={batch.progress} label={`Progress of ${batch.name}`} />
            <Counts batch={batch} />
            <span class="quiet small" title={moment(batch.created)}>{percent(batch.progress)} · {ago(batch.created)}</span>
          </li>
        ))}
      </ul>
    </>
  );
}

function Counts({ batch }: { batch: Batch }) {
  const counts = Object.entries(batch.counts).filter(([, count]) => count > 0);
  return <span class="counts">{counts.map(([state, count]) => <span key={state}>{count} <Badge state={state} /></span>)}</span>;
}

function One({ id }: { id: string }) {
  const batch = useFetched<Batch>(`/v1/batches/${id}`);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  useEvents("/v1/events", useThrottled(batch.again, 1000));
  useTitle(batch.data?.name ?? "Batch");
  const { data } = batch;
  if (data === null) return <Trouble trouble={batch.trouble} />;
  const open = (data.counts.queued ?? 0) + (data.counts.running ?? 0) > 0;
  return (
    <>
      <div class="page-head">
        <h1>{data.name === "" ? data.id : data.name}</h1>
        {open && (
          <button type="button" onClick={() => { send("POST", `/v1/batches/${id}/cancel`).then(batch.again, (error: unknown) => { setTrouble(troubleOf(error)); }); }}>
            Cancel all
          </button>
        )}
      </div>
      <Trouble trouble={trouble ?? batch.trouble} />
      <div class="card"><Bar fraction={data.progress} label="Progress of the batch" /><Counts batch={data} /></div>
      {data.jobs !== undefined && <Table jobs={data.jobs} />}
    </>
  );
}
