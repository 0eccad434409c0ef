// The frame round all views: who asks, where in the page, light or dark.

import { render } from "preact";
import { lazy, Suspense } from "preact/compat";
import { useEffect, useState } from "preact/hooks";

import { forgetKey, get, KEY_CHANGED, onLocked, Problem, useKey } from "./api";
import { useRoute } from "./hooks";
import { nextTheme, type Theme, theme, setTheme } from "./theme";
import type { Me } from "./types";
import { Batches } from "./views/batches";
import { Dashboard } from "./views/dashboard";
import { JobView } from "./views/job";
import { SignIn } from "./views/signin";
import { Submit } from "./views/submit";

const Result = lazy(() => import("./views/result"));

const LINKS: [string, string][] = [["jobs", "Jobs"], ["batches", "Batches"], ["new", "New job"]];

function View({ route }: { route: string[] }) {
  const [first = "jobs", id, more] = route;
  if (first === "new") return <Submit dataset={id ?? null} />;
  if (first === "batches") return <Batches id={id ?? null} />;
  if (first === "jobs" && id !== undefined && more === "result") {
    return (
      <Suspense fallback={<p class="quiet">Loading…</p>}>
        <Result job={id} />
      </Suspense>
    );
  }
  if (first === "jobs" && id !== undefined) return <JobView key={id} id={id} />;
  return <Dashboard />;
}

function ThemeButton() {
  const [now, setNow] = useState<Theme>(theme());
  const words: Record<Theme, string> = { auto: "as the system", light: "light", dark: "dark" };
  return (
    <button
      type="button"
      class="icon-button"
      aria-label={`Colors: ${words[now]}. Change`}
      title={`Colors: ${words[now]}`}
      onClick={() => {
        const next = nextTheme(now);
        setTheme(next);
        setNow(next);
      }}
    >
      <span aria-hidden="true">{now === "auto" ? "◐" : now === "light" ? "☀" : "☾"}</span>
    </button>
  );
}

function Frame() {
  const route = useRoute();
  const [me, setMe] = useState<Me | null>(null);
  const [locked, setLocked] = useState(false);
  const [problem, setProblem] = useState("");
  const leave = (): void => {
    forgetKey();
    setMe(null);
    setLocked(true);
    setProblem("");
  };
  const enter = (): void => {
    get<Me>("/v1/me").then(
      (answer) => {
        setMe(answer);
        setLocked(false);
        setProblem("");
      },
      (error: unknown) => {
        if (error instanceof Problem && error.code === KEY_CHANGED) return;
        const refused = error instanceof Problem && error.status === 401;
        if (refused) leave();
        setProblem(refused ? error.cause_ : "The server cannot be reached.");
        if (!refused) setTimeout(enter, 3000);
      },
    );
  };
  useEffect(enter, []);
  useEffect(() => { onLocked(() => { enter(); }); }, []);
  useEffect(() => {
    document.getElementById("main")?.focus({ preventScroll: true });
    scrollTo(0, 0);
  }, [route.join("/")]);
  const alone = me?.result !== undefined;
  return (
    <>
      <a class="skip" href="#main" onClick={(event) => { event.preventDefault(); document.getElementById("main")?.focus(); }}>
        Skip to content
      </a>
      <header class="top">
        <a class="brand" href={alone ? "#/" : "#/jobs"}>
          <Mark /> lvba
        </a>
        {!alone && <nav aria-label="Main">
          {LINKS.map(([to, word]) => (
            <a key={to} href={`#/${to}`} {...((route[0] ?? "jobs") === to ? { "aria-current": "page" as const } : {})}>
              {word}
            </a>
          ))}
        </nav>}
        <div class="top-end">
          {me?.auth === true && <span class="quiet owner">{me.owner}</span>}
          {me?.auth === true && <button type="button" onClick={leave}>Sign out</button>}
          <ThemeButton />
        </div>
      </header>
      <main id="main" tabIndex={-1}>
        {alone ? <Suspense fallback={<p class="quiet">Loading…</p>}><Result job={null} /></Suspense> : me !== null ? <View route={route} /> : locked ? (
          <SignIn problem={problem} enter={(key, stay) => { useKey(key, stay); enter(); }} />
        ) : <p class="quiet" role="status">{problem === "" ? "Loading…" : `${problem} Trying again.`}</p>}
      </main>
    </>
  );
}

function Mark() {
  return (
    <svg class="mark" viewBox="0 0 32 32" aria-hidden="true">
      <rect width="32" height="32" rx="8" class="mark-ground" />
      <path d="M9 22 16 18 23 20M12 12 20 10" class="mark-line" />
      <g class="mark-points">
        <circle cx="9" cy="22" r="2.6" /><circle cx="16" cy="18" r="2.6" /><circle cx="23" cy="20" r="2.6" />
        <circle cx="12" cy="12" r="2" /><circle cx="20" cy="10" r="2" />
      </g>
    </svg>
  );
}

setTheme(theme());
const root = document.getElementById("root");
if (root !== null) render(<Frame />, root);
