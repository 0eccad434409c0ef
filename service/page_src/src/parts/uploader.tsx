// Choosing files, sending them with progress, pausing and continuing, and waiting for the server's check.

import { useEffect, useRef, useState } from "preact/hooks";

import { get, send, troubleOf } from "../api";
import { BAG, inspectBag, isBag, type Look } from "../bag";
import { pause } from "../events";
import { bytes, count, duration, percent, plural } from "../format";
import type { Dataset } from "../types";
import { checkNames, dropped, isArchive, type Item, placedAt, type Progress, Upload, withoutCommonFolder } from "../upload";
import { Bar, Trouble } from "./basic";
import { InspectionTable } from "./inspection";

type Phase = "choose" | "sending" | "paused" | "checking" | "ended";

export function Uploader({ unfinished, ready, failed }: { unfinished: Dataset | null; ready: (dataset: Dataset) => void; failed: (dataset: Dataset) => void }) {
  const [phase, setPhase] = useState<Phase>("choose");
  const [items, setItems] = useState<Item[]>([]);
  const [name, setName] = useState("");
  const [folder, setFolder] = useState("");
  const [progress, setProgress] = useState<Progress | null>(null);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const [look, setLook] = useState<Look | "looking" | null>(null);
  const [reading, setReading] = useState(false);
  const drops = useRef(0);
  const upload = useRef<Upload | null>(null);
  const looking = useRef(new AbortController());
  const stop = useRef(new AbortController());
  useEffect(() => () => { stop.current.abort(); looking.current.abort(); }, []);
  useEffect(() => {
    if (phase !== "sending") return;
    const warn = (event: BeforeUnloadEvent): void => { event.preventDefault(); };
    addEventListener("beforeunload", warn);
    return () => { removeEventListener("beforeunload", warn); };
  }, [phase]);

  const wrong = unfinished?.state === "invalid" ? (unfinished.error?.path ?? null) : null;
  const take = (given: Item[]): void => {
    drops.current++;
    setReading(false);
    const kept = wrong === null ? withoutCommonFolder(given) : placedAt(given, wrong);
    const folder = given[0]?.path.includes("/") === true ? given[0].path.split("/")[0] : given.find((item) => BAG.test(item.path) || given.length === 1)?.file.name.replace(/\.(zip|tar.*|tgz)$/i, "").replace(BAG, "");
    setItems(kept);
    setFolder(folder ?? "");
    setName(unfinished?.name ?? folder ?? "");
    setTrouble(null);
    lookInto(kept, folder ?? "");
  };

  /** The browser reads a large folder for a while: what was chosen before must not be sent meanwhile. */
  const takeDropped = async (transfer: DataTransfer): Promise<void> => {
    const drop = ++drops.current;
    setItems([]);
    setTrouble(null);
    setReading(true);
    try {
      const given = await dropped(transfer);
      if (drop === drops.current) take(given);
    } catch (error) {
      if (drop !== drops.current) return;
      setReading(false);
      setTrouble(troubleOf(error));
    }
  };

  /** Shows what is in a bag, while its upload may already be on its way. */
  const lookInto = (kept: Item[], folder: string): void => {
    looking.current.abort();
    looking.current = new AbortController();
    const { signal } = looking.current;
    setLook(isBag(kept) ? "looking" : null);
    if (!isBag(kept)) return;
    inspectBag(kept, folder, signal).then(
      (seen) => { if (!signal.aborted) setLook(seen); },
      (error: unknown) => {
        if (signal.aborted) return;
        setLook(null);
        setTrouble(troubleOf(error));
      },
    );
  };

  const run = async (): Promise<void> => {
    setTrouble(null);
    setPhase("sending");
    stop.current = new AbortController();
    try {
      const refused = unfinished === null && upload.current === null ? await checkNames(items, folder) : null;
      if (refused !== null) {
        setPhase("choose");
        setTrouble(refused);
        return;
      }
      if (upload.current === null) {
        const dataset = unfinished ?? (await send<Dataset>("POST", "/v1/datasets", { name }));
        upload.current = new Upload(dataset.id, items, unfinished?.state === "invalid" ? (wrong ?? "") : null, setProgress);
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
        failed(dataset);
      }
    } catch (error) {
      setPhase("paused");
      if (!stop.current.signal.aborted) setTrouble(troubleOf(error));
    }
  };

  const total = items.reduce((sum, item) => sum + item.file.size, 0);
  if (phase === "choose") {
    return (
      <>
        {unfinished !== null && (wrong === null || wrong === "" ? <p>Choose the same files as before: only what is missing from <strong>{unfinished.name}</strong>, or differs, is sent.</p> : (
          <p>In <strong>{unfinished.name}</strong>, <code>{wrong}</code> is missing or wrong: {unfinished.error?.hint}. Choose it alone, or the whole folder again: only what differs is sent.</p>
        ))}
        <Chooser take={take} takeDropped={(transfer) => { void takeDropped(transfer); }} single={wrong !== null && wrong !== ""} />
        {reading && <p class="quiet" role="status">Reading the folder …</p>}
        <Trouble trouble={trouble} />
        {items.length > 0 && (
          <div class="chosen">
            <p>{isArchive(items) ? `Archive ${items[0]?.file.name ?? ""}` : plural(items.length, "file")}, {bytes(total)}</p>
            <label for="dataset-name">Name</label>
            <input id="dataset-name" value={name} disabled={unfinished !== null} onInput={(event) => { setName(event.currentTarget.value); }} />
            <Looked look={look} />
            <button type="button" class="primary" disabled={name.trim() === "" || (look !== null && look !== "looking" && look.error !== null)} onClick={() => { void run(); }}>Upload</button>
          </div>
        )}
      </>
    );
  }
  return (
    <div class="sending">
      <Sending phase={phase} progress={progress} total={total} />
      <Trouble trouble={trouble} />
      {phase !== "ended" && <Looked look={look} />}
      {phase === "sending" && <button type="button" onClick={() => { stop.current.abort(); }}>Pause</button>}
      {phase === "paused" && <button type="button" class="primary" onClick={() => { void run(); }}>Continue</button>}
    </div>
  );
}

function Looked({ look }: { look: Look | "looking" | null }) {
  if (look === null) return null;
  if (look === "looking") return <p class="quiet" role="status">Looking into the bag …</p>;
  return (
    <>
      <Trouble trouble={look.error} />
      {look.later !== "" && <p class="quiet small">{look.later}</p>}
      {look.inspection !== null && <InspectionTable inspection={look.inspection} label="What is in the bag" />}
    </>
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

/** single: files may be chosen, too, not only folders and archives. */
function Chooser({ take, takeDropped, single }: { take: (items: Item[]) => void; takeDropped: (transfer: DataTransfer) => void; single: boolean }) {
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
        if (event.dataTransfer !== null) takeDropped(event.dataTransfer);
      }}
    >
      <p><strong>Drop a recording here</strong>: its folder, an archive of it, or a bag with its calibration</p>
      <div class="drop-buttons">
        <label class="button file-button">
          Choose folder
          <input type="file" class="visually-hidden" ref={(input) => { input?.setAttribute("webkitdirectory", ""); }} onChange={(event) => { take(list(event.currentTarget.files)); }} />
        </label>
        {single && (
          <label class="button file-button">
            Choose files
            <input type="file" multiple class="visually-hidden" onChange={(event) => { take(list(event.currentTarget.files)); }} />
          </label>
        )}
        <label class="button file-button">
          Choose bag
          <input type="file" multiple class="visually-hidden" accept=".bag,.mcap,.db3,.zst,.zstd,.yaml,.yml,.txt,.json,.csv,.xml,.tum" onChange={(event) => { take(list(event.currentTarget.files)); }} />
        </label>
        <label class="button file-button">
          Choose archive
          <input type="file" class="visually-hidden" accept=".zip,.tar,.tgz,.gz,.bz2,.xz" onChange={(event) => { take(list(event.currentTarget.files)); }} />
        </label>
      </div>
      <p class="quiet small">all_image, all_pcd_body and config.yaml, as FAST-LIVO2 writes them; zip or tar; or bags of ROS 1, ROS 2 and MCAP. An interrupted upload continues where it stopped.</p>
    </div>
  );
}
