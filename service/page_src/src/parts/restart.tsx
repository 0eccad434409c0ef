// Restarting a job from a stage, or with other settings; stages that do not depend on them are reused.

import { useMemo, useRef, useState } from "preact/hooks";

import { send } from "../api";
import { useFetched } from "../hooks";
import type { Job, Options } from "../types";
import { Trouble } from "./basic";
import { type Changes, fieldsOf, flat, nested, OptionsForm, placed } from "./options";
import { grouped } from "./stages";

export function Restart({ job, done }: { job: Job; done: () => void }) {
  const dialog = useRef<HTMLDialogElement>(null);
  const [open, setOpen] = useState(false);
  return (
    <>
      <button type="button" onClick={() => { setOpen(true); dialog.current?.showModal(); }}>Restart…</button>
      <dialog ref={dialog} class="wide" aria-labelledby="restart-title" onClose={() => { setOpen(false); }}>
        {open && <Form job={job} close={() => { dialog.current?.close(); }} done={done} />}
      </dialog>
    </>
  );
}

function Form({ job, close, done }: { job: Job; close: () => void; done: () => void }) {
  const options = useFetched<Options>("/v1/options");
  const before = useMemo(() => (options.data === null ? {} : flat(job.config, fieldsOf(options.data))), [options.data]);
  const [edited, setEdited] = useState<Changes | null>(null);
  const [from, setFrom] = useState("");
  const [trouble, setTrouble] = useState<{ cause: string; hint: string } | null>(null);
  const [errors, setErrors] = useState<Record<string, string>>({});
  const names = grouped(job.stages ?? []).map((group) => group.whole?.name ?? group.parts[0]?.name ?? group.name).filter((one) => one !== "import");
  const restart = async (): Promise<void> => {
    try {
      await send("POST", `/v1/jobs/${job.id}/restart`, { ...(from === "" ? {} : { from }), ...(edited === null ? {} : { config: nested(edited) }) });
      close();
      done();
    } catch (error) {
      const { trouble: rest, errors: refused } = placed(error, options.data);
      setTrouble(rest);
      setErrors(refused);
    }
  };
  return (
    <form method="dialog" onSubmit={(event) => { event.preventDefault(); void restart(); }}>
      <h2 id="restart-title">Restart {job.name}</h2>
      <p class="quiet">Finished stages are reused unless a setting that they depend on changes.</p>
      <div class="field">
        <label for="restart-from">Repeat</label>
        <select id="restart-from" value={from} onChange={(event) => { setFrom(event.currentTarget.value); }}>
          <option value="">missing stages, and those that depend on changed settings</option>
          {names.map((name) => <option key={name} value={name}>{name}, and the stages that depend on it</option>)}
        </select>
      </div>
      <details class="more">
        <summary>Settings</summary>
        {options.data !== null && <OptionsForm options={options.data} changes={edited ?? before} set={setEdited} errors={errors} />}
      </details>
      <Trouble trouble={trouble ?? options.trouble} />
      <div class="actions dialog-end">
        <button type="button" onClick={close}>Cancel</button>
        <button type="submit" class="primary">Restart</button>
      </div>
    </form>
  );
}
