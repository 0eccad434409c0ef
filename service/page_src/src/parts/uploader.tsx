// Choosing files, sending them with progress, pausing and going on, and waiting for the server's check.

import { useEffect, useRef, useState } from "preact/hooks";

import { get, send, told } from "../api";
import { pause } from "../events";
import { bytes, count, duration, percent, plural } from "../format";
import type { Dataset } from "../types";
import { dropped, isArchive, type Item, type Progress, Upload, withoutCommonFolder } from "../upload";
import { Bar, Trouble } from "./basic";

type Phase = "choose" | "sending" | "paused" | "checking" | "ended";

export function Uploader({ unfinished, ready }: { unfinished: Dataset | null; ready: (dataset: Dataset) => void }) {
  const [phase, setPhase] = useState<Phase>("choose");
  const [items, setItems] = useState<Item[]>([]);
  const [name, setName] = useState("");
  const [progress, setProgress] = useState<Progress | null>(null);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const upload = useRef<Upload | null>(null);
  const stop = useRef(new AbortController());
  useEffect(() => () => { stop.current.abort(); }, []);
  useEffect(() => {
    if (phase !== "sending") return;
    const warn = (event: BeforeUnloadEvent): void => { event.preventDefault(); };
    addEventListener("beforeunload", warn);
    return () => { removeEventListener("beforeunload", warn); };
  }, [phase]);

  const take = (found: Item[]): void => {
    const kept = withoutCommonFolder(found);
    const folder = found[0]?.path.includes("/") === true ? found[0].path.split("/")[0] : found[0]?.file.name.replace(/\.(zip|tar.*|tgz)$/i, "");
    setItems(kept);
    setName(unfinished?.name ?? folder ?? "");
    setTrouble(null);
  };

  const run = async (): Promise<void> => {
    setTrouble(null);
    setPhase("sending");
    stop.current = new AbortController();
    try {
      if (upload.current === null) {
        const dataset = unfinished ?? (await send<Dataset>("POST", "/v1/datasets", { name }));
        upload.current = new Upload(dataset.id, items, setProgress);
      }
      await upload.current.run(stop.current.signal);
      setPhase("checking");
      await upload.current.finish();
      const dataset = await checked(upload.current.dataset, stop.current.signal);
      if (dataset.state === "ready") {
        setPhase("ended");
        ready(dataset);
      } else {
        const { cause, hint } = dataset.error ?? { cause: "The recording is not valid.", hint: "" };
        upload.current = null;
        setPhase("choose");
        setTrouble({ cause, hint });
      }
    } catch (error) {
      setPhase("paused");
      if (!stop.current.signal.aborted) setTrouble(told(error));
    }
  };

  const total = items.reduce((sum, item) => sum + item.file.size, 0);
  if (phase === "choose") {
    return (
      <>
        {unfinished !== null && <p>Choose the same files as before: only what is missing from <strong>{unfinished.name}</strong> is sent.</p>}
        <Chooser take={take} />
        <Trouble trouble={trouble} />
        {items.length > 0 && (
          <div class="chosen">
            <p>{isArchive(items) ? `Archive ${items[0]?.file.name ?? ""}` : plural(items.length, "file")}, {bytes(total)}</p>
            <label for="dataset-name">Name</label>
            <input id="dataset-name" value={name} disabled={unfinished !== null} onInput={(event) => { setName(event.currentTarget.value); }} />
            <button type="button" class="primary" disabled={name.trim() === ""} onClick={() => { void run(); }}>Upload</button>
          </div>
        )}
      </>
    );
  }
  return (
    <div class="sending">
      <Sending phase={phase} progress={progress} total={total} />
      <Trouble trouble={trouble} />
      {phase === "sending" && <button type="button" onClick={() => { stop.current.abort(); }}>Pause</button>}
      {phase === "paused" && <button type="button" class="primary" onClick={() => { void run(); }}>Go on</button>}
    </div>
  );
}

function Sending({ phase, progress, total }: { phase: Phase; progress: Progress | null; total: number }) {
  const fraction = progress === null || progress.total === 0 ? 0 : progress.sent / progress.total;
  if (phase === "checking") {
    return (
      <>
        <Bar fraction={null} label="Checking the recording" />
        <p role="status">Everything is there. The server is checking the recording …</p>
      </>
    );
  }
  const speed = progress?.bytesPerSecond ?? 0;
  const left = speed > 0 && progress !== null ? (progress.total - progress.sent) / speed : null;
  return (
    <>
      <Bar fraction={fraction} label="Upload" state={phase === "paused" ? "paused" : "running"} />
      <p>
        <strong>{percent(fraction)}</strong> of {bytes(total)}
        {progress !== null && progress.files > 1 && `, ${count(progress.filesDone)} of ${count(progress.files)} files`}
        {phase === "paused" ? ", paused" : speed > 0 && `, ${bytes(speed)}/s, ${duration(left)} left`}
      </p>
      <p class="visually-hidden" role="status">{phase === "paused" ? "Upload paused" : `Upload ${String(Math.floor(fraction * 10) * 10)} percent`}</p>
      {progress !== null && progress.trouble !== "" && <p class="field-problem" role="status">{progress.trouble}</p>}
    </>
  );
}

async function checked(id: string, signal: AbortSignal): Promise<Dataset> {
  for (let wait = 300; !signal.aborted; wait = Math.min(3000, wait * 1.5)) {
    const dataset = await get<Dataset>(`/v1/datasets/${id}`, signal);
    if (dataset.state === "ready" || dataset.state === "invalid") return dataset;
    await pause(wait, signal);
  }
  throw new DOMException("stopped", "AbortError");
}

function Chooser({ take }: { take: (items: Item[]) => void }) {
  const [over, setOver] = useState(false);
  const list = (files: FileList | null): Item[] =>
    [...(files ?? [])].map((file) => ({ path: file.webkitRelativePath === "" ? file.name : file.webkitRelativePath, file }));
  return (
    <div
      class={`drop${over ? " drop-over" : ""}`}
      onDragOver={(event) => { event.preventDefault(); setOver(true); }}
      onDragLeave={() => { setOver(false); }}
      onDrop={(event) => {
        event.preventDefault();
        setOver(false);
        if (event.dataTransfer !== null) void dropped(event.dataTransfer).then(take);
      }}
    >
      <p><strong>Drop a recording here</strong>: its folder, or an archive of it</p>
      <div class="drop-buttons">
        <label class="button file-button">
          Choose folder
          <input type="file" class="visually-hidden" ref={(input) => { input?.setAttribute("webkitdirectory", ""); }} onChange={(event) => { take(list(event.currentTarget.files)); }} />
        </label>
        <label class="button file-button">
          Choose archive
          <input type="file" class="visually-hidden" accept=".zip,.tar,.tgz,.gz,.bz2,.xz" onChange={(event) => { take(list(event.currentTarget.files)); }} />
        </label>
      </div>
      <p class="quiet small">all_image, all_pcd_body and config.yaml, as FAST-LIVO2 writes them; zip or tar. An upload that breaks goes on where it stopped.</p>
    </div>
  );
}
