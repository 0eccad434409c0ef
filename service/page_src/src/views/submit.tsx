// A new job: which recording, which settings, what it will take.

import type { ComponentChildren } from "preact";
import { useEffect, useMemo, useState } from "preact/hooks";

import { all, send, troubleOf } from "../api";
import { about, bytes } from "../format";
import { go, useFetched, useTitle } from "../hooks";
import { Card, Facts, Trouble } from "../parts/basic";
import { type Changes, nested, OptionsForm, placed } from "../parts/options";
import { ImportForm, InspectionTable } from "../parts/inspection";
import { Choice, Unfinished } from "../parts/recordings";
import { Uploader } from "../parts/uploader";
import type { AllOptions, Dataset, Estimate, Info, Inspection, Job } from "../types";

export function Submit({ dataset: wanted }: { dataset: string | null }) {
  const datasets = useFetched<Dataset[]>("/v1/datasets", (path) => all<Dataset>(path));
  const info = useFetched<Info>("/v1/info");
  useTitle("New job");
  const [chosen, setChosen] = useState<string | null>(wanted);
  const [unfinished, setUnfinished] = useState<Dataset | null>(null);
  const ready = (datasets.data ?? []).filter((dataset) => dataset.state === "ready");
  const open = (datasets.data ?? []).filter((dataset) => dataset.state === "uploading" || dataset.state === "invalid");
  const gone = (): void => { setUnfinished(null); datasets.again(); };
  const dataset = ready.find((one) => one.id === chosen) ?? null;
  return (
    <>
      <div class="page-head"><h1>New job</h1></div>
      <JobForm dataset={dataset}>
          <Card title="1. Recording" id="recording">
            <Trouble trouble={datasets.trouble} />
            {ready.length > 0 && (
              <fieldset class="choices">
                <legend>On the server</legend>
                {ready.map((one) => <Choice key={one.id} dataset={one} checked={one.id === chosen} choose={() => { setChosen(one.id); }} gone={gone} />)}
              </fieldset>
            )}
            {/* not before it is known what is there: it would fold over what somebody has just chosen */}
            {(datasets.data !== null || datasets.trouble !== null) && (
              <details open={ready.length === 0 || unfinished !== null} key={unfinished?.id ?? "new"} class="more">
                <summary>{ready.length === 0 ? "Upload" : "Upload another"}</summary>
                <Uploader key={unfinished?.id ?? "new"} unfinished={unfinished} ready={(one) => { setUnfinished(null); setChosen(one.id); datasets.again(); }} failed={(one) => { setUnfinished(one); datasets.again(); }} />
              </details>
            )}
            {(info.data?.roots ?? []).length > 0 && <Register roots={info.data?.roots ?? []} done={datasets.again} />}
            {open.length > 0 && <Unfinished datasets={open} resume={setUnfinished} gone={gone} />}
          </Card>
      </JobForm>
    </>
  );
}

function Register({ roots, done }: { roots: string[]; done: () => void }) {
  const [folder, setFolder] = useState("");
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  return (
    <details class="more">
      <summary>A folder on the server</summary>
      <label for="folder">Folder below {roots.join(" or ")}</label>
      <input id="folder" value={folder} placeholder={`${roots[0] ?? ""}/recording`} onInput={(event) => { setFolder(event.currentTarget.value); }} />
      <button
        type="button"
        onClick={() => {
          const name = folder.replace(/\/+$/, "").split("/").pop() ?? folder;
          send("POST", "/v1/datasets", { name, folder }).then(() => { setTrouble(null); done(); setTimeout(done, 3000); }, (error: unknown) => { setTrouble(troubleOf(error)); });
        }}
      >
        Add
      </button>
      <Trouble trouble={trouble} />
    </details>
  );
}

function JobForm({ dataset, children }: { dataset: Dataset | null; children: ComponentChildren }) {
  const options = useFetched<AllOptions>("/v1/options");
  const isBag = (dataset?.facts?.format ?? null) !== null;
  const inspection = useFetched<Inspection>(isBag && dataset !== null ? `/v1/datasets/${dataset.id}/inspection` : null);
  const [choices, setChoices] = useState<Changes>({});
  const [refusedChoices, setRefusedChoices] = useState<Record<string, string>>({});
  const [name, setName] = useState("");
  const [changes, setChanges] = useState<Changes>({});
  const [reference, setReference] = useState(false);
  const [priority, setPriority] = useState(0);
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const [errors, setErrors] = useState<Record<string, string>>({});
  const [sending, setSending] = useState(false);
  const [mark, setMark] = useState(() => crypto.getRandomValues(new Uint32Array(4)).join("-"));
  useEffect(() => {
    if (dataset !== null) setName(dataset.name);
    setReference(dataset?.facts?.has_reference === true);
  }, [dataset?.id]);
  const body = useMemo(() => ({ dataset: dataset?.id ?? "", name, config: nested(changes), ...(isBag ? { import: choices } : {}), priority, reference }), [dataset, name, changes, isBag, choices, priority, reference]);
  const submit = async (): Promise<void> => {
    setSending(true);
    setTrouble(null);
    setErrors({});
    setRefusedChoices({});
    try {
      const job = await send<Job>("POST", "/v1/jobs", body, { "Idempotency-Key": mark });
      go("jobs", job.id);
    } catch (error) {
      setMark(crypto.getRandomValues(new Uint32Array(4)).join("-"));
      const { trouble: rest, errors: refused } = placed(error, options.data);
      const chosen = placed(error, options.data?.import ?? null, "import");
      const aboutImport = Object.keys(chosen.errors).length > 0;
      setTrouble(aboutImport ? chosen.trouble : rest);
      setErrors(refused);
      setRefusedChoices(chosen.errors);
      setSending(false);
    }
  };
  return (
    <div class="columns">
      <div>
        {children}
      {isBag && (
        <Card title="2. Import" id="import">
          <Trouble trouble={inspection.trouble} />
          {inspection.data !== null && options.data !== null && (
            <>
              <InspectionTable inspection={inspection.data} label="What can be imported" />
              <ImportForm options={options.data.import} inspection={inspection.data} changes={choices} set={setChoices} errors={refusedChoices} />
            </>
          )}
        </Card>
      )}
      <Card title={isBag ? "3. Start" : "2. Start"} id="start">
        <div class="field"><label for="job-name">Name of the job</label><input id="job-name" value={name} onInput={(event) => { setName(event.currentTarget.value); }} /></div>
        <div class="field">
          <label for="priority">Priority</label>
          <select id="priority" value={String(priority)} onChange={(event) => { setPriority(Number(event.currentTarget.value)); }}>
            <option value="5">high</option><option value="0">normal</option><option value="-5">low</option>
          </select>
        </div>
        {dataset?.facts?.has_reference === true && (
          <label class="check"><input type="checkbox" checked={reference} onChange={(event) => { setReference(event.currentTarget.checked); }} /> Compare with the reference in the recording</label>
        )}
        {dataset !== null && <Cost body={body} />}
        <Trouble trouble={trouble} />
        <button type="button" class="primary large" disabled={dataset === null || sending} onClick={() => { void submit(); }}>
          {dataset === null ? "Choose a recording first" : "Start"}
        </button>
      </Card>
      </div>
      <Card title="Settings (optional)" id="settings">
        <Trouble trouble={options.trouble} />
        {options.data !== null && <OptionsForm options={options.data} changes={changes} set={setChanges} errors={errors} />}
      </Card>
    </div>
  );
}

/** What the job will take, as the server estimates. */
function Cost({ body }: { body: object }) {
  const [estimate, setEstimate] = useState<Estimate | null>(null);
  useEffect(() => {
    let current = true;
    const timer = setTimeout(() => {
      send<Estimate>("POST", "/v1/estimates", body).then(
        (estimate) => { if (current) setEstimate(estimate); },
        () => { if (current) setEstimate(null); },
      );
    }, 400);
    return () => { current = false; clearTimeout(timer); };
  }, [body]);
  if (estimate === null) return null;
  return (
    <>
      <Facts rows={[["Takes", estimate.seconds === null ? "–" : about(estimate.seconds)], ["Memory", bytes(estimate.memory_bytes)], ["Disk", bytes(estimate.disk_bytes)]]} />
      {estimate.basis !== undefined && <p class="quiet small">Estimated from {estimate.basis}.</p>}
      {(estimate.warnings ?? []).map((warning) => <p key={warning} class="field-problem">{warning}</p>)}
    </>
  );
}
