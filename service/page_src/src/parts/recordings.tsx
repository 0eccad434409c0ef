// Recordings on the server: which one to take, which to continue, and getting rid of those that are not needed.

import { useRef, useState } from "preact/hooks";

import { send, troubleOf } from "../api";
import { ago, bytes, duration, plural } from "../format";
import type { Dataset } from "../types";
import { Trouble } from "./basic";

export function Choice({ dataset, checked, choose, gone }: { dataset: Dataset; checked: boolean; choose: () => void; gone: () => void }) {
  const { facts } = dataset;
  return (
    <div class="choice-row">
      <label class={`choice${checked ? " choice-on" : ""}`}>
        <input type="radio" name="dataset" checked={checked} onChange={choose} />
        <span>
          <strong>{dataset.name}</strong>
          <span class="quiet small">
            {facts === null ? "" : `${facts.format ? `${facts.format}, ` : ""}${plural(facts.scans, "scan")}, ${plural(facts.images, "image")}, ${duration(facts.duration_s)} · `}{size(dataset)} · {ago(dataset.created)}
          </span>
        </span>
      </label>
      <Delete dataset={dataset} gone={gone} />
    </div>
  );
}

function size(dataset: Dataset): string {
  return dataset.source === "folder" ? "a folder on the server" : bytes(dataset.bytes);
}

/** Uploads that were not finished, and recordings in which something is missing or wrong. */
export function Unfinished({ datasets, resume, gone }: { datasets: Dataset[]; resume: (dataset: Dataset) => void; gone: () => void }) {
  return (
    <ul class="unfinished" aria-label="Unfinished uploads">
      {datasets.map((one) => (
        <li key={one.id}>
          <strong>{one.name}</strong>: {one.state === "invalid" ? `${one.error?.cause ?? "invalid"}; ${one.error?.hint ?? ""}` : `${bytes(one.bytes)} there`}
          <span class="actions">
            {one.source === "upload" && <button type="button" class="link" aria-label={`continue ${one.name}`} onClick={() => { resume(one); }}>continue</button>}
            <span class="quiet small">{size(one)}</span>
            <Delete dataset={one} gone={gone} />
          </span>
        </li>
      ))}
    </ul>
  );
}

function Delete({ dataset, gone }: { dataset: Dataset; gone: () => void }) {
  const dialog = useRef<HTMLDialogElement>(null);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const remove = (): void => {
    send("DELETE", `/v1/datasets/${dataset.id}`).then(
      () => { dialog.current?.close(); gone(); },
      (error: unknown) => { setTrouble(troubleOf(error)); },
    );
  };
  const title = `delete-${dataset.id}`;
  return (
    <>
      <button type="button" class="link danger" aria-label={`delete ${dataset.name}`} onClick={() => { setTrouble(null); dialog.current?.showModal(); }}>delete</button>
      <dialog ref={dialog} aria-labelledby={title}>
        <h2 id={title}>Delete {dataset.name}?</h2>
        <p>
          {dataset.source === "folder" ? "The folder stays where it lies; the server forgets it." : `${bytes(dataset.bytes)} on the server's disk become free.`}
          {" "}Results of its jobs stay, but none of these jobs can be restarted.
        </p>
        <Trouble trouble={trouble} />
        <div class="actions dialog-end">
          <button type="button" onClick={() => { dialog.current?.close(); }}>Keep it</button>
          <button type="button" class="danger" onClick={remove}>Delete</button>
        </div>
      </dialog>
    </>
  );
}
